// The real program among faults: two processes on one run, full disks, limits, closed pipes and streams, signals, kills
// at its file calls. A run that is gone on with ends in the bits of the run left alone.
#include "tests/program.h"

#include <alloca.h>
#include <fmt/format.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdio>

#include "run/run_folder.h"
#include "system/files.h"
#include "system/process.h"
#include "tests/crash/victim_runs.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_train;
using namespace testing_crash;
using namespace testing_program;
using Words = std::vector<std::string>;

constexpr int kSteps = 80;
constexpr double kHang_s = 120;  // a program that has not ended by then never will

Result run(const Words& words, const TempDir& dir, const std::vector<std::string>& environment = {}) {
  return Process(program(), words, dir.path(), environment).wait();
}

// The checkpoint that kSteps end in, however often they are saved.
std::uint32_t whole_fingerprint() {
  static const std::uint32_t made = [] {
    const TempDir dir;
    const std::string config = write_packed_config(dir, kSteps, 0);
    EXPECT_EQ(run({"train", config, "--out", dir / "run"}, dir).code, 0);
    return checkpoint_fingerprint(dir / "run", kSteps);
  }();
  return made;
}

bool wait_until(const std::function<bool()>& is_true, double seconds = kHang_s) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(seconds);
  while (!is_true()) {
    if (std::chrono::steady_clock::now() >= end) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  return true;
}

// Rows are there, so steps are under way and stop signals wait for them.
bool wait_for_steps(const std::string& run_dir) {
  return wait_until(
      [&] { return fs::exists(run_dir + "/metrics.jsonl") && fs::file_size(run_dir + "/metrics.jsonl") > 0; });
}

bool has(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

void expect_goes_on_to_the_same_bits(const std::string& config, const std::string& run_dir, const TempDir& dir) {
  const bool begun = fs::exists(run_dir + "/run.yaml");
  const Result r =
      succeeded(run(begun ? Words{"train", "--resume", run_dir} : Words{"train", config, "--out", run_dir}, dir));
  EXPECT_EQ(checkpoint_fingerprint(run_dir, kSteps), whole_fingerprint());
}

TEST(Program, ASecondProcessOnARunIsRefusedAndReadersAreNot) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 1'000'000, 0.05);
  const std::string run_dir = dir / "run";
  Process first(program(), {"train", config, "--out", run_dir}, dir.path());
  ASSERT_TRUE(wait_until([&] { return fs::exists(run_dir + "/checkpoints/latest"); }));
  const TempDir other;
  for (const Words& words : {Words{"train", "--resume", run_dir}, Words{"train", config, "--out", run_dir}}) {
    EXPECT_ENDED(run(words, other), 73,
                 fmt::format("the run folder '{}' is in use by process {}", run_dir, first.pid()),
                 "wait for it to end, stop it, or choose another folder with --out");
  }
  // Evaluation reads the newest checkpoint between two saves and takes none of the files that are being written.
  for (int i = 0; i < 3; ++i) (void)succeeded(run({"eval", run_dir}, other));
  first.send(SIGTERM);
  const std::optional<Result> stopped = first.wait_for(kHang_s);
  ASSERT_TRUE(stopped.has_value());
  EXPECT_EQ(stopped->code, 143) << stopped->err;
}

TEST(Program, AFileSizeLimitIsAFailedWriteAndNoSignal) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0);
  EXPECT_ENDED(semfield_run("train " + shell_word(config) + " --out run", dir.path(), "ulimit -f 64; "), 74,
               "the limit of a file's size is reached: need ", "raise it with `ulimit -f`",
               "there is no checkpoint yet");
  expect_goes_on_to_the_same_bits(config, dir / "run", dir);
}

// The call that opens one file too many, wherever it is: each limit moves it.
TEST(Program, TooFewOpenFilesAreAnErrorAtEveryPlace) {
#if defined(__SANITIZE_ADDRESS__)
  GTEST_SKIP() << "the sanitizers open a pipe to look at an object's type, and take a failure for a wrong one";
#endif
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0), run_dir = dir / "run";
  int refused = 0, done = 0;
  for (rlim_t most = 4; done == 0 && most < 64; ++most) {
    fs::remove_all(run_dir);
    const Result r = Process(program(), {"train", config, "--out", run_dir, "--steps", "2"}, dir.path(), {},
                             Limit{RLIMIT_NOFILE, most})
                         .wait();
    EXPECT_EQ(r.signal, 0) << r.err;
    done += r.code == 0 ? 1 : 0;
    if (r.code == 0 || r.code == 127) continue;  // 127: the loader could not open a library
    ++refused;
    EXPECT_TRUE(r.code == 74 || r.code == 66)
        << r.code << ": " << r.err;  // 66: when it is the scene that cannot be read
    EXPECT_HAS(r.err, "Too many open files");
  }
  EXPECT_EQ(done, 1);
  EXPECT_GE(refused, 2);
}

TEST(Program, TooLittleMemoryIsASentence) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "a sanitizer reserves more address space than any limit allows";
#endif
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0), run_dir = dir / "run";
  const Words words{"train", config, "--out", run_dir, "--steps", "2", "--threads", "1"};
  int refused = 0, done = 0;
  for (rlim_t most = rlim_t{30} << 20; done == 0 && most < (rlim_t{4} << 30); most += most / 32) {
    fs::remove_all(run_dir);
    // Less does not even start it: the allocator of TBB ends the process before main() by a signal.
    if (Process(program(), {"--version"}, dir.path(), {}, Limit{RLIMIT_AS, most}).wait().code != 0) continue;
    const Result r = Process(program(), words, dir.path(), {"OMP_NUM_THREADS=1"}, Limit{RLIMIT_AS, most}).wait();
    EXPECT_EQ(r.signal, 0) << most << ": " << r.err;
    done += r.code == 0 ? 1 : 0;
    if (r.code == 0 || r.code == 127) continue;
    ++refused;
    EXPECT_ENDED(r, 1, "ut of memory");  // libgomp itself writes "Out of memory"
  }
  EXPECT_EQ(done, 1);
  EXPECT_GE(refused, 1);
}

// Pages of the stack below here, as a deep call takes them.
__attribute__((noinline)) void use_stack(std::size_t bytes) {
  auto* const stack = static_cast<volatile char*>(alloca(bytes));
  for (std::size_t at = bytes; at >= 4096; at -= 4096) stack[at - 1] = 0;
}

// How a process ends that uses its stack when its address space is used up.
int signal_of_full_process(bool claims) {
  const pid_t pid = fork();
  if (pid == 0) {
    const bool claimed = claims && claim_stack();
    const rlimit none{4096, 4096};
    setrlimit(RLIMIT_AS, &none);
    use_stack(std::size_t{900} << 10);
    _exit(claimed == claims && !claim_stack() ? 0 : 1);
  }
  int status = 0;
  waitpid(pid, &status, 0);
  return WIFSIGNALED(status) ? WTERMSIG(status) : WEXITSTATUS(status);
}

TEST(Program, AStackThatWasClaimedIsThereWhenNoMemoryIs) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "a sanitizer reserves more address space than any limit allows";
#endif
  EXPECT_EQ(signal_of_full_process(false), SIGSEGV);
  EXPECT_EQ(signal_of_full_process(true), 0);
}

TEST(Program, ADiskThatFillsUnderTheLogNamesTheCheckpointKept) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0), run_dir = dir / "run", log = dir / "log";
  ASSERT_EQ(run({"train", config, "--out", run_dir}, dir, fault_environment(run_dir, log, {})).code, 0);
  std::vector<int> rows;
  for (const FileCall& call : read_calls(log)) {
    if (call.name == "write" && call.path.ends_with("metrics.jsonl")) rows.push_back(call.number);
  }
  ASSERT_GE(rows.size(), 10u);
  fs::remove_all(run_dir);
  const Fault full{rows[5], std::to_string(ENOSPC), true};
  EXPECT_ENDED(run({"train", config, "--out", run_dir}, dir, fault_environment(run_dir, dir / "l", full)), 74,
               "training ended at step 30 (there is no checkpoint yet: a resume begins at step 0; resume with "
               "`semfield train --resume " +
                   shell_word(run_dir) + "`): cannot append to '" + run_dir + "/metrics.jsonl': disk full: need ");
  expect_goes_on_to_the_same_bits(config, run_dir, dir);
}

TEST(Program, KilledAtItsFileCallsItGoesOn) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0.01), run_dir = dir / "run", log = dir / "log";
  ASSERT_EQ(run({"train", config, "--out", run_dir}, dir, fault_environment(run_dir, log, {})).code, 0);
  const auto calls = static_cast<int>(read_calls(log).size());
  ASSERT_GT(calls, 100);
  const char* wanted = std::getenv("SEMFIELD_TORTURE_CALLS");  // 0: every call
  const int places = wanted == nullptr ? 6 : std::atoi(wanted) == 0 ? calls : std::atoi(wanted);
  int kills = 0;
  for (int i = 0; i < places; ++i) {
    fs::remove_all(run_dir);
    const Fault fault{1 + static_cast<int>(static_cast<std::int64_t>(calls) * i / places),
                      i % 2 == 0 ? "kill_before" : "kill_after", false};
    kills +=
        run({"train", config, "--out", run_dir}, dir, fault_environment(run_dir, dir / "l", fault)).signal == SIGKILL;
    expect_goes_on_to_the_same_bits(config, run_dir, dir);
    for (const auto& entry : fs::recursive_directory_iterator(run_dir))
      EXPECT_NE(entry.path().extension(), ".tmp") << "left by a kill at call " << fault.call << ": " << entry.path();
  }
  EXPECT_GE(kills, places * 3 / 4);
}

TEST(Program, AReaderThatLeavesIsNoErrorAndAFullStdoutIs) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0);
  const auto code_of = [&](const std::string& words, const std::string& reader) {
    const std::string command = "cd " + shell_word(dir.path()) + " && (sleep 0.1; " + shell_word(program()) + " " +
                                words + " 2>&1; echo $? >code) | " + reader + " >/dev/null";
    EXPECT_EQ(std::system(command.c_str()), 0);
    EXPECT_TRUE(wait_until([&] { return fs::exists(dir / "code") && fs::file_size(dir / "code") > 0; }));
    const std::string code = read_text_file(dir / "code");
    fs::remove(dir / "code");
    return code;
  };
  EXPECT_EQ(code_of("config schema", "head -1"), "0\n");
  EXPECT_EQ(code_of("config schema", "true"), "0\n");
  EXPECT_EQ(code_of("train config.yaml --out run", "true"), "0\n") << "training goes on without its reader";
  EXPECT_EQ(checkpoint_fingerprint(dir / "run", kSteps), whole_fingerprint());
  if (!fs::exists("/dev/full")) GTEST_SKIP() << "no /dev/full here: a full stdout was not tried";
  const int status =
      std::system((shell_word(program()) + " config schema >/dev/full 2>" + shell_word(dir / "err")).c_str());
  EXPECT_EQ(WEXITSTATUS(status), 74);
  EXPECT_HAS(read_text_file(dir / "err"), "cannot write the results to stdout");
}

TEST(Program, ClosedStreamsPutNoMessageIntoAFile) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0.01);
  const int status = std::system(
      (shell_word(program()) + " train " + shell_word(config) + " --out " + shell_word(dir / "run") + " <&- >&- 2>&-")
          .c_str());
  EXPECT_EQ(WEXITSTATUS(status), 0);
  EXPECT_EQ(checkpoint_fingerprint(dir / "run", kSteps), whole_fingerprint());
  for (const auto& entry : fs::recursive_directory_iterator(dir / "run")) {
    if (entry.is_regular_file()) {
      EXPECT_LACKS(read_text_file(entry.path().string()), "miou_present=") << entry.path();
    }
  }
}

TEST(Program, SighupSavesAndGoesOn) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 1'000'000, 0), run_dir = dir / "run";
  Process process(program(), {"train", config, "--out", run_dir}, dir.path());
  ASSERT_TRUE(wait_for_steps(run_dir));
  EXPECT_FALSE(fs::exists(run_dir + "/checkpoints/latest"));
  process.send(SIGHUP);
  ASSERT_TRUE(wait_until([&] { return has(process.err_so_far(), "saved as asked"); }));
  const std::string first = read_text_file(run_dir + "/checkpoints/latest");
  EXPECT_FALSE(process.wait_for(0.3).has_value()) << "it goes on";
  process.send(SIGHUP);
  ASSERT_TRUE(wait_until([&] { return read_text_file(run_dir + "/checkpoints/latest") != first; }));
  process.send(SIGTERM);
  const std::optional<Result> r = process.wait_for(kHang_s);
  ASSERT_TRUE(r.has_value());
  EXPECT_EQ(r->code, 143) << r->err;
}

// Sent at any moment from the start on: the program ends in time, with the signal's code, and the run can be gone on
// with.
TEST(Program, StopSignalsAreAnsweredInTimeAtAnyMoment) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, kSteps, 0.05), run_dir = dir / "run";
  // Moments spread over what a whole run takes here and now; more of them until one fell between steps.
  const auto start = std::chrono::steady_clock::now();
  ASSERT_EQ(run({"train", config, "--out", dir / "whole"}, dir).code, 0);
  const std::chrono::duration<double> whole = std::chrono::steady_clock::now() - start;
  int orderly = 0;
  for (int i = 0; i < 16 || (orderly == 0 && i < 320); ++i) {
    const int signal = i % 2 == 0 ? SIGTERM : SIGINT;
    const bool begun = fs::exists(run_dir + "/run.yaml");
    Process process(program(), begun ? Words{"train", "--resume", run_dir} : Words{"train", config, "--out", run_dir},
                    dir.path());
    std::this_thread::sleep_for(whole * (i % 16) / 16);
    process.send(signal);
    const std::optional<Result> r = process.wait_for(kHang_s);
    ASSERT_TRUE(r.has_value()) << "no end within " << kHang_s << " s";
    if (r->signal == signal) continue;  // it came before the program's first line
    if (r->code == 0) {                 // it came behind its last
      fs::remove_all(run_dir);
      continue;
    }
    EXPECT_EQ(r->code, 128 + signal) << r->err;
    EXPECT_HAS(r->err, "stopped");
    orderly += has(r->err, "stopped before the first step") ? 0 : 1;
  }
  EXPECT_GT(orderly, 0);
  expect_goes_on_to_the_same_bits(config, run_dir, dir);
}

// Steps of seconds, and one that has just begun: the first signal is still waiting when the next come. People press
// Ctrl-C twice because nothing has answered yet, not to lose what they wait for; the third ends at once.
TEST(Program, ASecondSigintIsAnsweredAndAThirdEndsAtOnceWithTheOldCheckpoint) {
  for (const int signals : {2, 3}) {
    const TempDir dir;
    const std::string config = write_packed_config(dir, 2, 0), run_dir = dir / "run";
    ASSERT_EQ(run({"train", config, "--out", run_dir, "--set", "train.rays=100000"}, dir).code, 0);
    Process process(program(), {"train", "--resume", run_dir, "--steps", "1000", "--threads", "1"}, dir.path());
    ASSERT_TRUE(wait_until([&] { return has(process.err_so_far(), "resuming at step 2"); }));
    process.send(SIGHUP);
    ASSERT_TRUE(wait_until([&] { return has(process.err_so_far(), "saved as asked"); }));
    const std::string latest = read_text_file(run_dir + "/checkpoints/latest");
    for (int i = 1; i < signals; ++i) {
      process.send(SIGINT);
      EXPECT_FALSE(process.wait_for(0.05).has_value()) << "a step was to be under way";
    }
    process.send(SIGINT);
    const std::optional<Result> r = process.wait_for(kHang_s);
    ASSERT_TRUE(r.has_value());
    EXPECT_EQ(r->code, 130) << r->err;
    EXPECT_HAS(r->err, signals == 2 ? "after its checkpoint; resume with `semfield train --resume "
                                    : "ended at once; what was saved before is whole\n");
    EXPECT_EQ(has(r->err, "stopped at step"), signals == 2) << r->err;
    if (signals == 2) {
      EXPECT_HAS(r->err, "still stopping: what was done is being saved; once more ends without that\n");
    }
    EXPECT_EQ(read_text_file(run_dir + "/checkpoints/latest") == latest, signals == 3) << "was the step waited for";
    Diagnostics damaged;
    EXPECT_TRUE(CheckpointStore::read(run_dir + "/checkpoints").find_latest(damaged).has_value());
    EXPECT_TRUE(damaged.all().empty());
  }
}

}  // namespace
}  // namespace semfield
