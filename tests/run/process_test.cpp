// The real program, killed and signalled: no run is lost, and what is resumed ends in the bits of the run left alone.
#include <gtest/gtest.h>
#include <signal.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <thread>

#include "core/rng.h"
#include "execution/device_library.h"
#include "run/checkpoint_store.h"
#include "system/files.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing_program::program;
using testing_program::Result;

class Process : public testing_program::Process {
 public:
  Process(const std::vector<std::string>& words, const TempDir& dir)
      : testing_program::Process(program(), words, dir.path()) {}
};

Result run(const std::vector<std::string>& words, const TempDir& dir) { return Process(words, dir).wait(); }

int kills_wanted() {
  const char* wanted = std::getenv("SEMFIELD_TORTURE_KILLS");
  return wanted != nullptr ? std::max(1, std::atoi(wanted)) : 50;
}

// What a kill leaves behind, before anything is cleaned.
struct Remains {
  bool begun = false;      ///< run.yaml is there, so the run can be resumed
  std::int64_t step = -1;  ///< of the newest checkpoint; -1: none
  std::string bad;         ///< a checkpoint that does not verify
  int temporaries = 0;
};

Remains remains_of(const std::string& run_dir) {
  Remains found;
  found.begun = std::filesystem::exists(run_dir + "/run.yaml");
  if (!std::filesystem::exists(run_dir)) return found;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(run_dir))
    found.temporaries += entry.path().extension() == ".tmp" ? 1 : 0;
  if (!std::filesystem::exists(run_dir + "/checkpoints")) return found;
  Diagnostics diagnostics;
  try {
    const auto newest = CheckpointStore::read(run_dir + "/checkpoints").find_latest(diagnostics);
    if (newest) found.step = newest->step;
  } catch (const Error& error) {
    found.bad = error.what();
  }
  for (const Diagnostic& finding : diagnostics.all()) found.bad += finding.text();
  return found;
}

TEST(Process, RandomKillsLoseNoRunAndChangeNoBit) {
  const TempDir dir;
  const int steps = 200, wanted = kills_wanted();
  write_packed_config(dir, steps, 0.02);
  // Small steps: a thousand kills are about starts, saves and resumes.
  const std::string config = dir / "small.yaml";
  write_file_atomic(config, "include: config.yaml\ntrain: {rays: 24}\nruntime: {threads: 1}\n");
  const auto start = std::chrono::steady_clock::now();
  ASSERT_EQ(run({"train", config, "--out", dir / "whole"}, dir).code, 0);
  const double whole_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  const std::uint32_t whole = checkpoint_fingerprint(dir / "whole", steps);

  const std::string victim = dir / "victim";
  int kills = 0, runs = 0, during_write = 0, before_run = 0, before_checkpoint = 0;
  std::int64_t step = -1;
  for (int attempt = 0; kills < wanted && attempt < 10 * wanted; ++attempt) {
    const bool begun = std::filesystem::exists(victim + "/run.yaml");
    Process process(begun ? std::vector<std::string>{"train", "--resume", victim}
                          : std::vector<std::string>{"train", config, "--out", victim},
                    dir);
    // Up to half of what the whole run takes on this machine, so that kills fall into every part of it.
    const double share = static_cast<double>(uniform01({7, 0, 1}, static_cast<std::uint64_t>(attempt)));
    std::this_thread::sleep_for(std::chrono::duration<double>(0.005 + 0.5 * whole_s * share));
    process.send(SIGKILL);
    const Result r = process.wait();
    if (r.signal != SIGKILL) {
      // The run reached its end between two kills: kill further runs of the same course.
      ASSERT_EQ(r.code, 0) << r.err;
      EXPECT_EQ(checkpoint_fingerprint(victim, steps), whole);
      std::filesystem::remove_all(victim);
      step = -1;
      ++runs;
      continue;
    }
    ++kills;
    const Remains left = remains_of(victim);
    EXPECT_EQ(left.bad, "") << "kill " << kills;
    EXPECT_GE(left.step, step) << "kill " << kills << " lost a checkpoint";
    step = left.step;
    before_run += left.begun ? 0 : 1;
    before_checkpoint += left.begun && left.step < 0 ? 1 : 0;
    during_write += left.temporaries > 0 ? 1 : 0;
    if (kills % 100 == 0) {
      std::printf("%d kills, %d runs ended\n", kills, runs);
      std::fflush(stdout);
    }
  }
  EXPECT_EQ(kills, wanted);
  const bool begun = std::filesystem::exists(victim + "/run.yaml");
  const Result r = run(begun ? std::vector<std::string>{"train", "--resume", victim}
                             : std::vector<std::string>{"train", config, "--out", victim},
                       dir);
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(checkpoint_fingerprint(victim, steps), whole);
  EXPECT_EQ(remains_of(victim).temporaries, 0);
  std::printf(
      "%d kills: %d before the run's folder was begun, %d before its first checkpoint, %d within a write; "
      "%d runs ended, all with the bits of the run left alone\n",
      kills, before_run, before_checkpoint, during_write, runs + 1);
}

void expect_orderly_stop(int signal, int code) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 1000000, 0);
  Process process({"train", config, "--out", dir / "run"}, dir);
  for (int i = 0; i < 12000 && !std::filesystem::exists((dir / "run") + "/metrics.jsonl"); ++i) {
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  std::this_thread::sleep_for(std::chrono::milliseconds(200));
  process.send(signal);
  const Result r = process.wait();
  EXPECT_EQ(r.code, code) << r.err;
  EXPECT_NE(r.err.find("semfield train --resume"), std::string::npos) << r.err;
  const Result resumed = run({"train", "--resume", dir / "run", "--time", "1s"}, dir);
  EXPECT_EQ(resumed.code, 0) << resumed.err;
  EXPECT_NE(resumed.err.find("resuming at step"), std::string::npos) << resumed.err;
}

TEST(Process, SigintSavesAndExits130) { expect_orderly_stop(SIGINT, 130); }
TEST(Process, SigtermSavesAndExits143) { expect_orderly_stop(SIGTERM, 143); }

TEST(Process, EvalPrintsOneJsonObject) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 30, 0);
  ASSERT_EQ(run({"train", config, "--out", dir / "run"}, dir).code, 0);
  const Result r = run({"--json", "eval", dir / "run"}, dir);
  ASSERT_EQ(r.code, 0) << r.err;
  for (const char* name : {"\"miou_present\":", "\"total_accuracy\":", "\"psnr\":", "\"absrel\":", "\"train_s\":",
                           "\"entropy_auroc\":", "\"auroc_error\":"}) {
    EXPECT_NE(r.out.find(name), std::string::npos) << name << " in " << r.out;
  }
  EXPECT_EQ(std::count(r.out.begin(), r.out.end(), '\n'), 1);
  EXPECT_EQ(r.out.find("given_right_entropy"), std::string::npos) << r.out;
  const Result trained = run({"--json", "eval", dir / "run", "--split", "train"}, dir);
  ASSERT_EQ(trained.code, 0) << trained.err;
  for (const char* name : {"\"given_right_entropy\":1.", "\"given_wrong_auroc\":null"})
    EXPECT_NE(trained.out.find(name), std::string::npos) << name << " in " << trained.out;
  const Result rendered = run({"render", dir / "run", "--split", "test", "--npy"}, dir);
  ASSERT_EQ(rendered.code, 0) << rendered.err;
  EXPECT_NE(rendered.out.find("frames=3"), std::string::npos) << rendered.out;
}

struct Refusal {
  std::vector<std::string> words;
  int code;
  std::string message;
};

TEST(Process, RefusalsNamePlaceCauseAndRemedy) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  ASSERT_EQ(run({"train", config, "--out", dir / "run"}, dir).code, 0);
  const std::string bad_key = dir / "bad_key.yaml";
  write_file_atomic(bad_key, "include: config.yaml\nsemantics: {wieght: 1}\ntrain: {rays: many}\n");
  std::vector<Refusal> cases{
      {{"train"}, 2, "expected either a configuration file or --resume RUN"},
      {{"trian", config}, 2, ""},
      {{"train", config, "--out", dir / "run"}, 73, "run"},
      {{"train", dir / "absent.yaml"}, 66, "absent.yaml"},
      {{"train", bad_key, "--out", dir / "x"},
       78,
       "bad_key.yaml:2:13: semantics: unknown key 'wieght'; did you mean 'weight'?"},
      {{"train", bad_key, "--out", dir / "x"}, 78, "bad_key.yaml:3:15: train.rays: expected int, got 'many'"},
      {{"train", config, "--time", "soon"}, 2, "expected a positive time"},
      {{"train", config, "--set", "passes.0.field.type=tiny_mpl", "--out", dir / "x"}, 78, "did you mean 'tiny_mlp'?"},
      {{"train", config, "--out", "/proc/semfield"}, 73, "/proc/semfield"},
      {{"train", "--resume", dir / "nowhere"}, 66, "nowhere"},
      {{"eval", dir / "nowhere"}, 66, "nowhere"},
      {{"eval", dir / "run", "--split", "best"}, 2, "expected test or train"},
      {{"train", config, "--set", "scene.load.invert_poses=true", "--out", dir / "x"},
       65,
       "add --set scene.load.invert_poses=false"},
      {{"train", config, "--keep", "undistorsion", "--dry-run"}, 2, "did you mean 'undistortion'?"},
  };
  std::string why_not;  // this build or this machine has none
  if (!cuda_available(&why_not))
    cases.push_back({{"train", config, "--set", "runtime.device=cuda", "--out", dir / "x"}, 69, why_not});
  for (const Refusal& c : cases) {
    const Result r = run(c.words, dir);
    EXPECT_EQ(r.code, c.code) << c.words[0] << ": " << r.err;
    EXPECT_NE(r.err.find(c.message), std::string::npos) << "expected '" << c.message << "' in: " << r.err;
  }
  EXPECT_FALSE(std::filesystem::exists(dir / "x")) << "a refused run leaves no folder";
}

}  // namespace
}  // namespace semfield
