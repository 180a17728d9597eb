// The log of label events: killed and failing at every file call, and killed 200 times between a click and its answer.
#include "labels/clicks/click_log.h"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstring>

#include "core/rng.h"
#include "tests/crash/victim_runs.h"

namespace semfield::testing_crash {
namespace {

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
        EXPECT_NE(r.err.find(trial.folder()), std::string::npos) << place << " names no path: " << r.err;
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
  // After so many answers and at some moment within the next clicks: before, in or after a write, or before its answer.
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
