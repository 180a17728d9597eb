// The real program, killed and signalled: no run is lost, and what is resumed ends in the bits of the run left alone.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <filesystem>
#include <fstream>
#include <thread>

#include "core/checksum.h"
#include "core/files.h"
#include "core/rng.h"
#include "scene/packed_scene.h"
#include "testkit/analytic_scene.h"
#include "tests/train/train_testing.h"
#include "train/checkpoint_store.h"

namespace semfield {
namespace {

using namespace testing_train;

struct Result {
  int code = -1;  ///< exit code, or -1 when a signal ended it
  int signal = 0;
  std::string out, err;
};

class Process {
 public:
  explicit Process(const std::vector<std::string>& words, const TempDir& dir)
      : out_(dir / "stdout"), err_(dir / "stderr") {
    std::vector<char*> argv{const_cast<char*>(SEMFIELD_BINARY)};
    for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
    argv.push_back(nullptr);
    pid_ = fork();
    if (pid_ == 0) {
      dup2(open(out_.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0600), 1);
      dup2(open(err_.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0600), 2);
      execv(SEMFIELD_BINARY, argv.data());
      _exit(127);
    }
  }
  void send(int signal) const { kill(pid_, signal); }
  Result wait() {
    int status = 0;
    waitpid(pid_, &status, 0);
    Result r;
    if (WIFEXITED(status)) r.code = WEXITSTATUS(status);
    if (WIFSIGNALED(status)) r.signal = WTERMSIG(status);
    r.out = read_text_file(out_);
    r.err = read_text_file(err_);
    return r;
  }

 private:
  std::string out_, err_;
  pid_t pid_ = -1;
};

Result run(const std::vector<std::string>& words, const TempDir& dir) { return Process(words, dir).wait(); }

// A packed analytic room and a configuration that saves all the time.
std::string write_config(const TempDir& dir, int steps, double checkpoint_every_s) {
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  write_packed_scene(dir / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
  std::string yaml = hash_config("report: {eval_every_s: 0, strips: 0, log_every_steps: 5, checkpoint_every_s: " +
                                 std::to_string(checkpoint_every_s) + "}\n");
  yaml.replace(yaml.find("{type: analytic_room}"), 21, "{type: packed, file: room.sfpack}");
  yaml.replace(yaml.find("steps: 200"), 10, "steps: " + std::to_string(steps));
  write_file_atomic(dir / "config.yaml", yaml);
  return dir / "config.yaml";
}

std::uint32_t checkpoint_crc(const std::string& run_dir, std::int64_t expected_step) {
  Diagnostics diagnostics;
  const CheckpointStore store(run_dir + "/checkpoints");
  auto found = store.find_latest(diagnostics);
  EXPECT_TRUE(found.has_value());
  EXPECT_TRUE(diagnostics.all().empty()) << diagnostics.all().front().text();
  if (!found) return 0;
  EXPECT_EQ(found->step, expected_step);
  std::uint32_t crc = 0;
  for (const TensorRef& t : found->file.tensors()) crc = crc32c(t.bytes, crc32c(std::as_bytes(std::span(t.name)), crc));
  return crc;
}

TEST(Process, FiftyKillsLoseNoRunAndChangeNoBit) {
  const TempDir dir;
  const int steps = 400;
  const std::string config = write_config(dir, steps, 0.02);
  ASSERT_EQ(run({"train", config, "--out", dir / "whole"}, dir).code, 0);
  const std::uint32_t whole = checkpoint_crc(dir / "whole", steps);

  const std::string victim = dir / "victim";
  int kills = 0, started_over = 0;
  for (int attempt = 0; kills < 50 && attempt < 500; ++attempt) {
    const bool begun = std::filesystem::exists(victim + "/run.yaml");
    started_over += begun ? 0 : 1;
    Process process(begun ? std::vector<std::string>{"train", "--resume", victim}
                          : std::vector<std::string>{"train", config, "--out", victim},
                    dir);
    const double wait_s = 0.01 + 0.4 * static_cast<double>(uniform01({7, 0, 1}, static_cast<std::uint64_t>(attempt)));
    std::this_thread::sleep_for(std::chrono::duration<double>(wait_s));
    process.send(SIGKILL);
    const Result r = process.wait();
    if (r.signal == SIGKILL) {
      ++kills;
    } else {
      ASSERT_EQ(r.code, 0) << r.err;
      // The run reached its end between two kills: kill further runs of the same course.
      EXPECT_EQ(checkpoint_crc(victim, steps), whole);
      std::filesystem::remove_all(victim);
    }
  }
  EXPECT_EQ(kills, 50);
  const bool begun = std::filesystem::exists(victim + "/run.yaml");
  const Result r = run(begun ? std::vector<std::string>{"train", "--resume", victim}
                             : std::vector<std::string>{"train", config, "--out", victim},
                       dir);
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(checkpoint_crc(victim, steps), whole);
  for (const auto& entry : std::filesystem::recursive_directory_iterator(victim)) {
    EXPECT_EQ(entry.path().filename().string().find(".tmp."), std::string::npos) << "left behind: " << entry.path();
  }
}

void expect_orderly_stop(int signal, int code) {
  const TempDir dir;
  const std::string config = write_config(dir, 1000000, 0);
  Process process({"train", config, "--out", dir / "run"}, dir);
  for (int i = 0; i < 400 && !std::filesystem::exists((dir / "run") + "/metrics.jsonl"); ++i) {
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
  const std::string config = write_config(dir, 30, 0);
  ASSERT_EQ(run({"train", config, "--out", dir / "run"}, dir).code, 0);
  const Result r = run({"--json", "eval", dir / "run"}, dir);
  ASSERT_EQ(r.code, 0) << r.err;
  for (const char* name : {"\"miou_present\":", "\"total_accuracy\":", "\"psnr\":", "\"absrel\":", "\"train_s\":"}) {
    EXPECT_NE(r.out.find(name), std::string::npos) << name << " in " << r.out;
  }
  EXPECT_EQ(std::count(r.out.begin(), r.out.end(), '\n'), 1);
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
  const std::string config = write_config(dir, 5, 0);
  ASSERT_EQ(run({"train", config, "--out", dir / "run"}, dir).code, 0);
  const std::string bad_key = dir / "bad_key.yaml";
  write_file_atomic(bad_key, "include: config.yaml\nsemantics: {wieght: 1}\ntrain: {rays: many}\n");
  const std::vector<Refusal> cases{
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
      {{"train", config, "--set", "runtime.device=cuda", "--out", dir / "x"}, 69, "no CUDA kernels"},
      {{"train", config, "--out", "/proc/semfield"}, 73, "/proc/semfield"},
      {{"train", "--resume", dir / "nowhere"}, 66, "nowhere"},
      {{"eval", dir / "nowhere"}, 66, "nowhere"},
      {{"eval", dir / "run", "--split", "best"}, 2, "expected train or test"},
      {{"train", config, "--keep", "undistorsion", "--dry-run"}, 2, "did you mean 'undistortion'?"},
  };
  for (const Refusal& c : cases) {
    const Result r = run(c.words, dir);
    EXPECT_EQ(r.code, c.code) << c.words[0] << ": " << r.err;
    EXPECT_NE(r.err.find(c.message), std::string::npos) << "expected '" << c.message << "' in: " << r.err;
  }
  EXPECT_FALSE(std::filesystem::exists(dir / "x")) << "a refused run leaves no folder";
}

}  // namespace
}  // namespace semfield
