// Completion scripts in the shells that they are for: what is offered for words as they are typed.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <memory>
#include <set>
#include <sstream>

#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_train::TempDir;

using Words = std::set<std::string>;

std::string output_of(const std::string& command) {
  const std::unique_ptr<FILE, int (*)(FILE*)> pipe(popen(command.c_str(), "r"), pclose);
  std::string text;
  std::array<char, 4096> buffer{};
  while (pipe && fgets(buffer.data(), static_cast<int>(buffer.size()), pipe.get()) != nullptr) text += buffer.data();
  return text;
}

// A shell with the program's script, in a folder that has a file room.yaml and a folder runs.
class Completion : public ::testing::TestWithParam<std::string> {
 protected:
  void SetUp() override {
    shell_ = GetParam();
    if (output_of("command -v " + shell_).empty())
      GTEST_SKIP() << shell_ << " is not installed: its script was not tried";
    const testing_program::Result r = testing_program::semfield_run("completion " + shell_, dir_.path());
    ASSERT_EQ(r.code, 0) << r.err;
    write_file_atomic(dir_ / "script", r.out);
    fs::create_directories(dir_ / "work/runs");
    write_file_atomic(dir_ / "work/room.yaml", std::string_view(""));
    write_file_atomic(dir_ / "try.bash", std::string_view(R"(source "$1"
# As readline cuts words: at blanks and at '='.
read -ra COMP_WORDS <<<"${2//=/ = }"
[[ $2 != *' ' ]] || COMP_WORDS+=('')
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_semfield 2>/dev/null
printf '%s\n' "${COMPREPLY[@]}"
)"));
    write_file_atomic(dir_ / "try.fish",
                      std::string_view("source $argv[1]; complete -C $argv[2] | string split -f 1 \\t\n"));
  }

  // What is offered where `line` ends, without what stands before "=" and the last comma.
  Words offered(const std::string& line) {
    const std::string script = shell_word(dir_ / "script"), words = shell_word(line);
    const std::string tool =
        shell_ == "zsh" ? SEMFIELD_SOURCE_DIR "/tests/command_line/zsh_candidates.zsh" : dir_ / ("try." + shell_);
    const std::string flags = shell_ == "bash" ? " --norc " : shell_ == "zsh" ? " -f " : " --no-config ";
    std::istringstream lines(
        output_of("cd " + shell_word(dir_ / "work") + " && HOME=" + shell_word(dir_.path()) +
                  " PATH=" + shell_word(fs::path(testing_program::program()).parent_path().string()) +
                  ":\"$PATH\" timeout 60 " + shell_ + flags + shell_word(tool) + " " + script + " " + words + " 2>&1"));
    Words out;
    for (std::string word; std::getline(lines, word);) {
      word = word.substr(word.rfind(',') + 1);
      if (const std::size_t equals = word.find('='); word.starts_with("--") && equals != std::string::npos)
        word = word.substr(equals + 1);
      if (word.ends_with('/')) word.pop_back();
      if (!word.empty()) out.insert(word);
    }
    return out;
  }

  std::string shell_;
  TempDir dir_;
};

TEST_P(Completion, Verbs) {
  const Words verbs = offered("semfield ");
  for (const char* verb : {"train", "config", "check-numerics", "completion", "help"})
    EXPECT_TRUE(verbs.contains(verb)) << verb;
  EXPECT_FALSE(verbs.contains("check"));
  EXPECT_EQ(offered("semfield tr"), Words{"train"});
  EXPECT_EQ(offered("semfield config "), (Words{"check", "diff", "explain", "schema"}));
  EXPECT_EQ(offered("semfield -q config ch"), Words{"check"});
  EXPECT_EQ(offered("semfield --plugin x.so config ch"), Words{"check"});
  EXPECT_EQ(offered("semfield help conf"), Words{"config"});
}

TEST_P(Completion, Flags) {
  EXPECT_EQ(offered("semfield eval --sp"), Words{"--split"});
  EXPECT_EQ(offered("semfield train room.yaml --dr"), Words{"--dry-run"});
  EXPECT_EQ(offered("semfield bench step --pe"), (Words{"--peers", "--peer-script"}));
  EXPECT_EQ(offered("semfield eval --vid"), Words{});
  EXPECT_EQ(offered("semfield --pl"), Words{"--plugin"});
  // --json where there is one.
  EXPECT_EQ(offered("semfield eval --js"), Words{"--json"});
  EXPECT_EQ(offered("semfield help --js"), Words{});
}

TEST_P(Completion, ChoicesOfValues) {
  EXPECT_EQ(offered("semfield eval runs --split "), (Words{"test", "train"}));
  EXPECT_EQ(offered("semfield eval runs --split te"), Words{"test"});
  EXPECT_EQ(offered("semfield eval runs --split=te"), Words{"test"});
  EXPECT_EQ(offered("semfield train --device c"), (Words{"cpu", "cuda"}));
  EXPECT_EQ(offered("semfield export runs --format co"), (Words{"coco", "coco_rle"}));
  EXPECT_EQ(offered("semfield mesh runs --format g"), Words{"glb"});
  EXPECT_EQ(offered("semfield mesh runs --format ply,g"), Words{"glb"});
  EXPECT_EQ(offered("semfield completion "), (Words{"bash", "fish", "zsh"}));
}

TEST_P(Completion, FilesAndFolders) {
  EXPECT_EQ(offered("semfield train "), (Words{"room.yaml", "runs"}));
  EXPECT_EQ(offered("semfield config check roo"), Words{"room.yaml"});
  EXPECT_EQ(offered("semfield eval "), Words{"runs"});
  EXPECT_EQ(offered("semfield train --out r"), Words{"runs"});
  EXPECT_EQ(offered("semfield inspect room.yaml --frusta roo"), Words{"room.yaml"});
  EXPECT_EQ(offered("semfield render runs --trajectory r"), (Words{"room.yaml", "runs"}));
  EXPECT_EQ(offered("semfield render runs --trajectory sm"), Words{"smooth"});
  EXPECT_EQ(offered("semfield train --steps "), Words{});
}

INSTANTIATE_TEST_SUITE_P(Shells, Completion, ::testing::Values("bash", "zsh", "fish"),
                         [](const auto& tried) { return tried.param; });

TEST(CompletionVerb, UnknownShell) {
  const TempDir dir;
  const testing_program::Result r = testing_program::semfield_run("completion zhs", dir.path());
  EXPECT_EQ(r.code, 2);
  EXPECT_EQ(r.err, "semfield: SHELL zhs: expected bash, zsh or fish; did you mean zsh? [usage.value.invalid]\n");
}

}  // namespace
}  // namespace semfield
