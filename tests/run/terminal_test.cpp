// What people see on a terminal: a live line within its width, which leaves nothing behind, and notes of whole words.
#include "app/terminal.h"

#include <poll.h>
#include <pty.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>

#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace app;
using namespace testing_program;
using namespace testing_train;

TEST(LiveLine, PartsGoByRankUntilTheRestFits) {
  const std::vector<LinePart> parts{{0, "step 5"}, {2, "  loss 1"}, {3, "  a 1"}, {3, "  b 2"}, {1, "  0:05 left"}};
  EXPECT_EQ(fitted(parts, 100), "step 5  loss 1  a 1  b 2  0:05 left");
  EXPECT_EQ(fitted(parts, 35), "step 5  loss 1  a 1  b 2  0:05 left");
  EXPECT_EQ(fitted(parts, 34), "step 5  loss 1  a 1  0:05 left");
  EXPECT_EQ(fitted(parts, 26), "step 5  loss 1  0:05 left");
  EXPECT_EQ(fitted(parts, 20), "step 5  0:05 left");
  EXPECT_EQ(fitted(parts, 16), "step 5");
  EXPECT_EQ(fitted(parts, 4), "step");
  EXPECT_EQ(fitted({{0, "Küche"}}, 5), "Küche") << "columns, not bytes";
  EXPECT_EQ(fitted({{0, "部屋の"}}, 5), "部屋") << "wide characters take two";
}

TEST(Notes, BreakBetweenWordsAndNeverInACommand) {
  EXPECT_EQ(wrapped("the length is settled", 80), "the length is settled");
  EXPECT_EQ(wrapped("the length is settled", 12), "the length\nis settled");
  EXPECT_EQ(wrapped("the length is settled", 10), "the length\nis settled");
  EXPECT_EQ(wrapped("go on with `semfield train --resume r`, or not", 20),
            "go on with\n`semfield train --resume r`,\nor not");
  EXPECT_EQ(wrapped("unbreakable/path/to/a/file is\n  indented", 8), "unbreakable/path/to/a/file\nis\n  indented");
  EXPECT_EQ(wrapped("a ` alone is no command", 9), "a ` alone\nis no\ncommand");
  EXPECT_EQ(wrapped("", 5), "");
}

// A terminal of 80 columns as far as the program uses one.
class Screen {
 public:
  static constexpr std::size_t kColumns = 80;
  void feed(std::string_view text) {
    for (std::size_t i = 0; i < text.size(); ++i) {
      const char c = text[i];
      if (c == '\r') {
        column_ = 0;
      } else if (c == '\n') {
        rows_.emplace_back();
        column_ = 0;
      } else if (text.substr(i, 3) == "\033[K") {
        rows_.back().resize(std::min(rows_.back().size(), column_));
        i += 2;
      } else if ((c & 0xC0) != 0x80) {
        if (column_ == kColumns) {  // goes on in the next row, in the middle of a word
          ++overflows_;
          rows_.emplace_back();
          column_ = 0;
        }
        std::string& row = rows_.back();
        row.resize(std::max(row.size(), column_ + 1), ' ');
        row[column_++] = c;
      }
    }
  }
  const std::vector<std::string>& rows() const { return rows_; }
  int overflows() const { return overflows_; }
  std::string text() const {
    std::string all;
    for (const std::string& row : rows_) all += row + "\n";
    return all;
  }

 private:
  std::vector<std::string> rows_{""};
  std::size_t column_ = 0;
  int overflows_ = 0;
};

// The program on a terminal of 80 columns: what its screen shows at the end, and everything that was written.
struct Shown {
  Screen screen;
  std::string written;
  int code = -1;
};
Shown on_terminal(const std::vector<std::string>& words, const std::string& folder) {
  const winsize size{.ws_row = 24, .ws_col = Screen::kColumns, .ws_xpixel = 0, .ws_ypixel = 0};
  const std::string path = program();
  std::vector<char*> argv{const_cast<char*>(path.c_str())};
  for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
  argv.push_back(nullptr);
  int terminal = -1;
  const pid_t pid = forkpty(&terminal, nullptr, nullptr, &size);
  if (pid == 0) {
    if (chdir(folder.c_str()) != 0) _exit(126);
    execv(path.c_str(), argv.data());
    _exit(127);
  }
  Shown shown;
  std::array<char, 4096> part{};
  for (ssize_t got = 0; (got = read(terminal, part.data(), part.size())) > 0;)
    shown.written.append(part.data(), static_cast<std::size_t>(got));
  close(terminal);
  int status = 0;
  waitpid(pid, &status, 0);
  shown.code = WIFEXITED(status) ? WEXITSTATUS(status) : -1;
  shown.screen.feed(shown.written);
  return shown;
}

std::size_t rows_with(const Screen& screen, std::string_view text) {
  std::size_t count = 0;
  for (const std::string& row : screen.rows()) count += row.find(text) != std::string::npos ? 1 : 0;
  return count;
}

TEST(Terminal, TrainingLeavesNoLitterAndNotesStandAlone) {
  const TempDir dir;
  write_packed_config(dir, 200, 60);
  const Shown train = on_terminal({"train", "config.yaml", "--time", "3s", "--out", "run", "--set",
                                   "report.log_every_steps=1", "--set", "report.eval_every_s=1"},
                                  dir.path());
  ASSERT_EQ(train.code, 0) << train.written;
  std::size_t updates = 0;
  for (std::size_t at = 0; (at = train.written.find("\r\033[Kstep ", at)) != std::string::npos; ++at) ++updates;
  ASSERT_GT(updates, 3u) << "the line is live";
  EXPECT_HAS(train.written, " left\r\033[K", "miou_present");
  EXPECT_EQ(rows_with(train.screen, "loss "), 0u) << train.screen.text();
  EXPECT_EQ(rows_with(train.screen, "elapsed"), 0u) << train.screen.text();
  // A note begins its row, and only what people copy runs over the edge.
  std::size_t settled = 0;
  for (const std::string& row : train.screen.rows()) settled += row.starts_with("the length is settled: ") ? 1 : 0;
  EXPECT_EQ(settled, 1u) << train.screen.text();
  EXPECT_EQ(rows_with(train.screen, "the length is settled"), 1u);
  for (const std::string& row : train.screen.rows()) EXPECT_LE(row.size(), Screen::kColumns);
  EXPECT_EQ(rows_with(train.screen, "next        semfield eval run"), 1u);

  for (const std::vector<std::string>& words : std::vector<std::vector<std::string>>{
           {"eval", "run"}, {"render", "run"}, {"mesh", "run"}, {"inspect", "config.yaml"}, {"report", "run"}}) {
    const Shown verb = on_terminal(words, dir.path());
    ASSERT_EQ(verb.code, 0) << verb.written;
    for (const char* live : {"scored ", "rendered ", "depth of ", "scene: "})
      EXPECT_EQ(rows_with(verb.screen, live), 0u) << words[0] << ":\n" << verb.screen.text();
  }
}

TEST(Terminal, AnErrorStandsAloneAndBreaksBetweenWords) {
  const TempDir dir;
  write_packed_config(dir, 200, 60);
  const Shown wrong = on_terminal({"train", "config.yaml", "--set", "train.steppes=1", "--set", "train.rays=many",
                                   "--set", "runtime.device=an_accelerator_of_a_long_name"},
                                  dir.path());
  EXPECT_EQ(wrong.code, 78);
  EXPECT_EQ(wrong.screen.overflows(), 0) << wrong.screen.text();
  EXPECT_HAS(wrong.screen.text(), "--set train.steppes=1: train: unknown key 'steppes'");
}

}  // namespace
}  // namespace semfield
