// Files that rot: 10,000 single bits flipped and 1,000 lengths cut, of checkpoints and of packed scenes. All are
// noticed, with the file's name, and a run goes on from the checkpoint before. (G09, G10)
#include <fcntl.h>
#include <signal.h>
#include <sys/wait.h>

#include <algorithm>
#include <cerrno>
#include <cstring>

#include "core/rng.h"
#include "labels/clicks/click_log.h"
#include "loading/packed_scene.h"
#include "run/run_folder.h"
#include "system/files.h"
#include "tests/crash/scenarios.h"
#include "tests/crash/victim_runs.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_crash {
namespace {

constexpr int kFlips = 10'000, kCuts = 1'000;

std::uint64_t draw(std::uint32_t stream, int index, std::uint64_t below) {
  const float u = uniform01({31, 0, stream}, static_cast<std::uint64_t>(index));
  return std::min(below - 1, static_cast<std::uint64_t>(static_cast<double>(u) * static_cast<double>(below)));
}

// A file whose bytes are changed in place, without the cost of writing all of it 10,000 times.
class Victim {
 public:
  explicit Victim(std::string path) : path_(std::move(path)), bytes_(read_text_file(path_)) {
    file_ = open(path_.c_str(), O_WRONLY | O_CLOEXEC);
  }
  Victim(const Victim&) = delete;
  Victim& operator=(const Victim&) = delete;
  ~Victim() { close(file_); }
  std::uint64_t bits() const { return 8 * bytes_.size(); }
  std::uint64_t size() const { return bytes_.size(); }
  void flip(std::uint64_t bit) const { put(bit / 8, static_cast<char>(bytes_[bit / 8] ^ (1 << (bit % 8)))); }
  void restore(std::uint64_t bit) const { put(bit / 8, bytes_[bit / 8]); }
  void cut(std::uint64_t size) const { ASSERT_EQ(ftruncate(file_, static_cast<off_t>(size)), 0); }
  void restore_all() const {
    ASSERT_EQ(pwrite(file_, bytes_.data(), bytes_.size(), 0), static_cast<ssize_t>(bytes_.size()));
  }
  const std::string& path() const { return path_; }

 private:
  void put(std::uint64_t at, char byte) const { ASSERT_EQ(pwrite(file_, &byte, 1, static_cast<off_t>(at)), 1); }
  std::string path_, bytes_;
  int file_ = -1;
};

struct Noticed {
  int tried = 0, noticed = 0, named = 0;
};

// `read` returns the message of the damage, "" when it saw none.
template <class Read>
Noticed damage(const Victim& file, Read&& read) {
  Noticed seen;
  const auto note = [&](const std::string& message) {
    ++seen.tried;
    seen.noticed += message.empty() ? 0 : 1;
    seen.named += message.find(file.path()) != std::string::npos ? 1 : 0;
  };
  for (int i = 0; i < kFlips; ++i) {
    // The first rounds go through the head of the file bit by bit, where the lengths stand; the rest is drawn.
    const std::uint64_t bit = i < 1'000 ? static_cast<std::uint64_t>(i) : draw(1, i, file.bits());
    file.flip(bit);
    note(read());
    file.restore(bit);
  }
  for (int i = 0; i < kCuts; ++i) {
    file.cut(draw(2, i, file.size()));
    note(read());
    file.restore_all();
  }
  return seen;
}

class Damage : public ::testing::Test {
 protected:
  const TempDir dir_;
  const std::string& folder_ = dir_.path();
};

TEST_F(Damage, OfACheckpointIsNoticedAndTheOneBeforeUsed) {
  prepare(Save::first, folder_);
  CheckpointStore store(folder_ + "/checkpoints");
  for (const int step : {100, 200}) {
    std::vector<float> values(300, static_cast<float>(step));
    store.save(step, {tensor_ref("main/field/hidden_0/weight", {10, 30}, values)}, {{"step", std::to_string(step)}});
  }
  const Victim file(folder_ + "/checkpoints/" + CheckpointStore::file_name(200));
  int went_back = 0;
  const Noticed seen = damage(file, [&]() -> std::string {
    Diagnostics diagnostics;
    const auto found = store.find_latest(diagnostics);
    went_back += found && found->step == 100 ? 1 : 0;
    return diagnostics.all().empty() ? std::string() : diagnostics.all().front().text();
  });
  EXPECT_EQ(seen.tried, kFlips + kCuts);
  EXPECT_EQ(seen.noticed, seen.tried);
  EXPECT_EQ(seen.named, seen.tried);
  EXPECT_EQ(went_back, seen.tried);
  Diagnostics diagnostics;
  EXPECT_EQ(store.find_latest(diagnostics)->step, 200) << "the control: undamaged, it is taken";
  std::printf("checkpoint of %llu bytes: %d of %d damages noticed\n", static_cast<unsigned long long>(file.size()),
              seen.noticed, seen.tried);
}

TEST_F(Damage, OfAPackedSceneIsNoticed) {
  prepare(Save::scene, folder_);
  const Victim file(folder_ + "/room.sfpack");
  const auto read = [&]() -> std::string {
    return error_of([&] {
      const PackedScene scene(file.path());
      FrameBuffer buffer;
      for (std::size_t i = 0; i < scene.info().frames.size(); ++i) scene.read(static_cast<int>(i), buffer);
    });
  };
  EXPECT_EQ(read(), "") << "the control: undamaged, it is read";
  const Noticed seen = damage(file, read);
  EXPECT_EQ(seen.tried, kFlips + kCuts);
  EXPECT_EQ(seen.noticed, seen.tried);
  EXPECT_EQ(seen.named, seen.tried);
  std::printf("packed scene of %llu bytes: %d of %d damages noticed\n", static_cast<unsigned long long>(file.size()),
              seen.noticed, seen.tried);
}

// The log of label events: killed and failing at every file call, and killed 200 times between a click and its
// acknowledgement.

TEST(ClickLogKill, AtEveryCallLeavesTheLogWithOrWithoutTheEvent) {
  const Undisturbed& u = undisturbed(Save::clicks);
  int kills = 0, with = 0, without = 0;
  for (const FileCall& call : u.calls) {
    for (const char* kind : {"kill_before", "kill_half", "kill_after"}) {
      if (std::string(kind) == "kill_half" && call.name != "write") continue;
      const std::string place = std::string(kind) + " " + call.name + " " + call.path;
      Trial trial(Save::clicks);
      ASSERT_EQ(trial.save({call.number, kind, false}).signal, SIGKILL) << place;
      const Look found = trial.look();
      EXPECT_EQ(found.bad, "") << place;
      EXPECT_TRUE(found.crc == u.old_crc || found.crc == u.new_crc) << place;
      (found.crc == u.old_crc ? without : with) += 1;
      ++kills;
    }
  }
  EXPECT_GT(with, 0);
  EXPECT_GT(without, 0);
  std::printf("%zu calls, %d kills, %d without the event, %d with it\n", u.calls.size(), kills, without, with);
}

TEST(ClickLogFaults, AtEveryCallAreToldAndLeaveTheLogAsItWas) {
  const Undisturbed& u = undisturbed(Save::clicks);
  int refused = 0;
  for (const FileCall& call : u.calls) {
    if (call.name != "open" && call.name != "read" && call.name != "write" && call.name != "fsync") continue;
    for (const int cause : {EIO, ENOSPC, EINTR}) {
      for (const bool sticky : {false, true}) {
        if (call.name == "read" && cause == ENOSPC) continue;
        if (sticky && cause != ENOSPC) continue;
        const std::string place = std::string(std::strerror(cause)) + " at " + call.name + " " + call.path;
        Trial trial(Save::clicks);
        const testing_program::Result r = trial.save({call.number, std::to_string(cause), sticky});
        const Look found = trial.look();
        EXPECT_EQ(found.bad, "") << place;
        if (cause == EINTR) {
          EXPECT_EQ(r.code, 0) << place << ": " << r.err;
          EXPECT_EQ(found.crc, u.new_crc) << place;
          continue;
        }
        ++refused;
        EXPECT_NE(r.code, 0) << place;
        EXPECT_HAS(r.err, trial.folder()) << place << " names no path: " << r.err;
        // Where not even the taking back succeeds, an event stays that was not acknowledged.
        if (sticky && call.name == "fsync") continue;
        EXPECT_EQ(found.crc, u.old_crc) << place << ": " << r.err;
      }
    }
  }
  EXPECT_GT(refused, 10);
}

TEST(ClickLogFaults, AShortWriteIsGoneOnWith) {
  const Undisturbed& u = undisturbed(Save::clicks);
  int tried = 0;
  for (const FileCall& call : u.calls) {
    if (call.name != "write" || !call.path.ends_with("/clicks.jsonl")) continue;
    ++tried;
    Trial trial(Save::clicks);
    EXPECT_EQ(trial.save({call.number, "short", false}).code, 0);
    EXPECT_EQ(trial.look().crc, u.new_crc);
  }
  EXPECT_EQ(tried, 1) << "an event is one write";
}

TEST(ClickLogFaults, TheEventIsSyncedAndSoIsItsFilesEntry) {
  const Undisturbed& u = undisturbed(Save::clicks);
  bool written = false, event = false, entry = false;
  for (const FileCall& call : u.calls) {
    written = written || call.name == "write";
    event = event || (written && call.name == "fsync" && call.path.ends_with("/clicks.jsonl"));
    entry = entry || (call.name == "fsync" && call.path.ends_with("/work"));
  }
  EXPECT_TRUE(event);
  EXPECT_TRUE(entry);
}

// `label` on one log, killed at some moment; the numbers that it said.
std::vector<int> label_until_killed(const Trial& trial, std::uint64_t round) {
  int ends[2];
  if (pipe2(ends, O_CLOEXEC) != 0) ADD_FAILURE() << std::strerror(errno);
  const std::string folder = trial.folder();
  const pid_t child = fork();
  if (child == 0) {
    dup2(ends[1], STDOUT_FILENO);
    execl(SEMFIELD_VICTIM, SEMFIELD_VICTIM, "label", name_of(Save::clicks), folder.c_str(), nullptr);
    _exit(127);
  }
  close(ends[1]);
  std::vector<int> said;
  int number = 0;
  // After so many acknowledgements and at some moment within the next clicks: before, in or after a write, or before
  // its acknowledgement.
  const RandomAddress address{1, round, stream_id("test/kill")};
  const auto answers = uniform_below(address, 0, 6);
  const auto moment_us = uniform_below(address, 1, 300);
  bool killed = false;
  while (read(ends[0], &number, sizeof number) == sizeof number) {
    said.push_back(number);
    if (!killed && said.size() > answers) {
      usleep(static_cast<useconds_t>(moment_us));
      kill(child, SIGKILL);  // what stands in the pipe is still read: it was acknowledged
      killed = true;
    }
  }
  int status = 0;
  waitpid(child, &status, 0);
  EXPECT_TRUE(WIFSIGNALED(status)) << "the process ended by itself with " << status;
  close(ends[0]);
  return said;
}

TEST(ClickLogKill, TwoHundredTimesBetweenClickAndAnswerLosesNoneThatWasAcknowledged) {
  const Trial trial(Save::clicks);
  int next = 2, torn = 0, unanswered = 0;
  for (std::uint64_t round = 0; round < 200; ++round) {
    const std::vector<int> said = label_until_killed(trial, round);
    ASSERT_FALSE(said.empty());
    for (const int number : said) ASSERT_EQ(number, next++) << "round " << round;
    Diagnostics diagnostics;
    const std::vector<LabelEvent> events = read_click_log(click_log_path(trial.folder()), diagnostics);
    torn += static_cast<int>(diagnostics.all().size());
    ASSERT_GE(std::ssize(events), next) << "an acknowledged click is lost in round " << round;
    ASSERT_LE(std::ssize(events), next + 1) << "more than one click without an answer in round " << round;
    unanswered += static_cast<int>(std::ssize(events)) - next;
    for (std::size_t i = 0; i < events.size(); ++i) ASSERT_EQ(events[i], click_event(static_cast<int>(i)));
    next = static_cast<int>(events.size());
  }
  std::printf("200 kills, %d clicks; %d were written and not answered, %d torn\n", next, unanswered, torn);
}

}  // namespace
}  // namespace semfield::testing_crash
