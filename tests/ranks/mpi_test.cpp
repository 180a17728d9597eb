// The program under mpirun: the files of one process from any number of them, and an end in order when one is killed.
#include <signal.h>

#include <fstream>
#include <sstream>

#include "core/text.h"
#include "system/files.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_train;
using namespace testing_program;

// More ranks than cores, also where nobody but root is there.
const std::vector<std::string> kEnvironment{"OMPI_ALLOW_RUN_AS_ROOT=1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1",
                                            "OMPI_MCA_rmaps_base_oversubscribe=1",
                                            "PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe"};

std::vector<std::string> words_of(int ranks, const std::vector<std::string>& words,
                                  const std::vector<std::string>& of_mpirun = {}) {
  std::vector<std::string> all{"-n", std::to_string(ranks), "--oversubscribe"};
  all.insert(all.end(), of_mpirun.begin(), of_mpirun.end());
  all.push_back(program());
  all.insert(all.end(), words.begin(), words.end());
  return all;
}

Result run(int ranks, const std::vector<std::string>& words, const TempDir& dir) {
  return Process(SEMFIELD_MPIRUN, words_of(ranks, words), dir.path(), kEnvironment).wait();
}
Result alone(const std::vector<std::string>& words, const TempDir& dir) {
  return Process(program(), words, dir.path()).wait();
}

int lines_with(const std::string& text, const std::string& part) {
  int count = 0;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) count += line.find(part) != std::string::npos ? 1 : 0;
  return count;
}

std::string two_pass_file(const TempDir& dir, int steps) {
  (void)write_packed_config(dir, steps, 0);
  std::string yaml =
      with_scene(two_pass_config("report: {eval_every_s: 0, strips: 0}\n"), "{type: packed, file: room.sfpack}");
  yaml.replace(yaml.find("steps: 50"), 9, "steps: " + std::to_string(steps));
  write_file_atomic(dir / "two_pass.yaml", yaml);
  return dir / "two_pass.yaml";
}

TEST(Mpirun, TrainsTheSameBitsOn1And2And3RanksOf1And2Threads) {
  const TempDir dir;
  constexpr int kSteps = 40;
  const std::string configs[] = {write_packed_config(dir, kSteps, 0), two_pass_file(dir, kSteps)};
  for (const std::string& config : configs) {
    const std::string name = fs::path(config).stem().string();
    ASSERT_EQ(alone({"train", config, "--out", dir / (name + "_alone"), "--threads", "1"}, dir).code, 0);
    const std::uint32_t expected = checkpoint_fingerprint(dir / (name + "_alone"), kSteps);
    for (const int ranks : {1, 2, 3}) {
      for (const char* threads : {"1", "2"}) {
        const std::string out = dir / (name + std::to_string(ranks) + threads);
        const Result trained = succeeded(run(ranks, {"train", config, "--out", out, "--threads", threads}, dir));
        EXPECT_EQ(checkpoint_fingerprint(out, kSteps), expected) << ranks << " ranks of " << threads;
        EXPECT_EQ(lines_with(trained.out, "train: "), 1) << trained.out;
      }
    }
  }
}

TEST(Mpirun, EvaluatesAndRendersWhatOneProcessDoes) {
  const TempDir dir;
  ASSERT_EQ(alone({"train", write_packed_config(dir, 30, 0), "--out", dir / "run"}, dir).code, 0);
  const Result score = alone({"eval", dir / "run", "--json"}, dir);
  EXPECT_EQ(run(3, {"eval", dir / "run", "--json"}, dir).out, score.out);
  ASSERT_EQ(alone({"render", dir / "run", "--out", dir / "one", "--npy"}, dir).code, 0);
  ASSERT_EQ(run(3, {"render", dir / "run", "--out", dir / "three", "--npy"}, dir).code, 0);
  int files = 0;
  for (const auto& entry : fs::recursive_directory_iterator(dir / "one")) {
    if (!entry.is_regular_file()) continue;
    ++files;
    const fs::path other = fs::path(dir / "three") / fs::relative(entry.path(), dir / "one");
    EXPECT_EQ(read_text_file(other.string()), read_text_file(entry.path().string())) << other;
  }
  EXPECT_GT(files, 10);
}

TEST(Mpirun, WeakMultipliesTheRaysAndTheRunSaysSo) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  ASSERT_EQ(run(2, {"train", config, "--out", dir / "weak", "--weak"}, dir).code, 0);
  EXPECT_HAS(read_text_file(dir / "weak/run.yaml"), "rays: 384");
  ASSERT_EQ(alone({"train", config, "--out", dir / "alone", "--set", "train.rays=384"}, dir).code, 0);
  EXPECT_EQ(checkpoint_fingerprint(dir / "weak", 5), checkpoint_fingerprint(dir / "alone", 5));
  const Result refused = run(2, {"train", "--resume", dir / "weak", "--weak"}, dir);
  EXPECT_EQ(refused.code, 2);
  EXPECT_HAS(refused.err, "--weak multiplies the rays of a new run");
}

TEST(Mpirun, SaysOnceWhatIsWrong) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  const Result flag = run(3, {"train", config, "--stepz", "3"}, dir);
  EXPECT_EQ(flag.code, 2);
  EXPECT_EQ(lines_with(flag.err, "semfield: train has no flag --stepz"), 1) << flag.err;
  const Result missing = run(3, {"train", dir / "none.yaml"}, dir);
  EXPECT_EQ(missing.code, 66);
  EXPECT_EQ(lines_with(missing.err, "semfield: "), 1) << missing.err;
  const Result verb = run(3, {"inspect", config}, dir);
  EXPECT_EQ(verb.code, 2);
  EXPECT_EQ(lines_with(verb.err, "mpirun started 3 processes, but `semfield inspect` works in one"), 1) << verb.err;
  // The folder exists: an error of rank 0 alone, after the others have begun to follow.
  ASSERT_EQ(run(2, {"train", config, "--out", dir / "run"}, dir).code, 0);
  const Result again = run(3, {"train", config, "--out", dir / "run"}, dir);
  EXPECT_NE(again.code, 0);
  EXPECT_EQ(lines_with(again.err, "semfield: "), 1) << again.err;
}

// The process of a rank, once it is there.
int process_of(int rank, const std::string& run_dir) {
  for (int attempt = 0; attempt < 2000; ++attempt) {
    for (const auto& entry : fs::directory_iterator("/proc")) {
      const std::string name = entry.path().filename().string();
      if (name.find_first_not_of("0123456789") != std::string::npos) continue;
      const auto text = [&](const char* file) {
        std::ifstream in(entry.path() / file, std::ios::binary);
        return std::string(std::istreambuf_iterator<char>(in), {});
      };
      const std::string words = text("cmdline");
      if (words.rfind(program(), 0) != 0 || words.find(run_dir) == std::string::npos) continue;
      const std::string variable = "OMPI_COMM_WORLD_RANK=" + std::to_string(rank);
      if (text("environ").find(variable + '\0') != std::string::npos) return std::stoi(name);
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  return -1;
}

std::int64_t newest_step(const std::string& run_dir) {
  std::int64_t newest = -1;
  if (!fs::exists(run_dir + "/checkpoints")) return newest;
  for (const auto& entry : fs::directory_iterator(run_dir + "/checkpoints")) {
    const std::string name = entry.path().filename().string();
    if (name.rfind("step_", 0) == 0) newest = std::max<std::int64_t>(newest, std::atoll(name.c_str() + 5));
  }
  return newest;
}

struct Kill {
  int rank;
  std::vector<std::string> of_mpirun;
};

TEST(Mpirun, AKilledRankEndsTheRunWithAMessageAndOneProcessGoesOnWithTheBitsOfAnUndisturbedRun) {
  const TempDir dir;
  constexpr int kSteps = 300;
  const std::string config = write_packed_config(dir, kSteps, 0.05);
  ASSERT_EQ(alone({"train", config, "--out", dir / "whole"}, dir).code, 0);
  const std::uint32_t whole = checkpoint_fingerprint(dir / "whole", kSteps);
  // A launcher that ends the others, and one that leaves that to them.
  const Kill kills[] = {{1, {}}, {2, {"--enable-recovery"}}, {0, {}}, {0, {"--enable-recovery"}}};
  int number = 0;
  for (const Kill& kill_one : kills) {
    SCOPED_TRACE("rank " + std::to_string(kill_one.rank) + (kill_one.of_mpirun.empty() ? "" : ", recovery"));
    const std::string out = dir / ("victim" + std::to_string(number++));
    Process process(SEMFIELD_MPIRUN, words_of(3, {"train", config, "--out", out, "--threads", "1"}, kill_one.of_mpirun),
                    dir.path(), kEnvironment);
    while (newest_step(out) < 20) std::this_thread::sleep_for(std::chrono::milliseconds(5));
    const int victim = process_of(kill_one.rank, out);
    ASSERT_GT(victim, 0);
    kill(victim, SIGKILL);
    const std::optional<Result> ended = process.wait_for(30);
    ASSERT_TRUE(ended.has_value()) << "still runs after 30 s";
    ASSERT_LT(newest_step(out), kSteps) << "it was killed too late";
    if (kill_one.rank != 0) {
      EXPECT_HAS(ended->err, "rank " + std::to_string(kill_one.rank) + " on ", "has ended",
                 "resume with `semfield train --resume ");
    }
    const Result resumed = succeeded(alone({"train", "--resume", out}, dir));
    EXPECT_EQ(checkpoint_fingerprint(out, kSteps), whole);
  }
}

// Of any rank, or of all of them at once, as launchers pass it on.
TEST(Mpirun, AStopSavesAndAnyNumberOfRanksGoesOn) {
  const TempDir dir;
  constexpr int kSteps = 400;
  const std::string config = write_packed_config(dir, kSteps, 0.05);
  ASSERT_EQ(alone({"train", config, "--out", dir / "whole"}, dir).code, 0);
  const std::uint32_t whole = checkpoint_fingerprint(dir / "whole", kSteps);
  int number = 0;
  for (const std::vector<int>& asked : {std::vector<int>{0}, {1}, {1, 0}, {0, 1}}) {
    SCOPED_TRACE("case " + std::to_string(number));
    const std::string out = dir / ("stopped" + std::to_string(number++));
    Process process(SEMFIELD_MPIRUN, words_of(2, {"train", config, "--out", out, "--threads", "1"}), dir.path(),
                    kEnvironment);
    while (newest_step(out) < 20) std::this_thread::sleep_for(std::chrono::milliseconds(5));
    std::vector<int> processes;
    for (const int rank : asked) processes.push_back(process_of(rank, out));
    for (const int pid : processes) {
      kill(pid, SIGTERM);
      std::this_thread::sleep_for(std::chrono::milliseconds(2));  // the other rank may hear of it first
    }
    const std::optional<Result> ended = process.wait_for(30);
    ASSERT_TRUE(ended.has_value()) << "still runs after 30 s";
    ASSERT_LT(newest_step(out), kSteps) << "it was asked too late";
    EXPECT_HAS(ended->err, "after its checkpoint; resume with `semfield train --resume");
    const Result resumed = succeeded(run(3, {"train", "--resume", out}, dir));
    EXPECT_EQ(checkpoint_fingerprint(out, kSteps), whole);
  }
}

// A verb that saves nothing ends at once, whichever rank got the signal.
TEST(Mpirun, AStopOfAnyRankEndsARendering) {
  const TempDir dir;
  ASSERT_EQ(alone({"train", write_packed_config(dir, 5, 0), "--out", dir / "run"}, dir).code, 0);
  Process process(
      SEMFIELD_MPIRUN,
      words_of(2, {"render", dir / "run", "--trajectory", "smooth", "--frames", "100000", "--out", dir / "v"}),
      dir.path(), kEnvironment);
  while (!fs::exists(dir / "v/cameras.json")) std::this_thread::sleep_for(std::chrono::milliseconds(5));
  kill(process_of(1, dir / "v"), SIGTERM);
  EXPECT_TRUE(process.wait_for(30).has_value()) << "still runs after 30 s";
}

TEST(Mpirun, RanksThatWereStartedWithOtherWordsAreRefused) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  // By a script: `mpirun ... : ...` of Open MPI 5.0.7 crashes.
  const auto both = [&](const std::vector<std::string>& first, const std::vector<std::string>& second) {
    const auto line = [](const std::vector<std::string>& words) {
      std::string text = "exec " + shell_word(program());
      for (const std::string& word : words) text += " " + shell_word(word);
      return text + "\n";
    };
    write_file_atomic(dir / "script",
                      "if [ \"$OMPI_COMM_WORLD_RANK\" = 0 ]; then " + line(first) + "fi\n" + line(second));
    return Process(SEMFIELD_MPIRUN, {"-n", "2", "--oversubscribe", "sh", dir / "script"}, dir.path(), kEnvironment)
        .wait();
  };
  const Result other =
      both({"train", config, "--out", dir / "a"}, {"train", config, "--out", dir / "a", "--steps", "9"});
  EXPECT_EQ(other.code, 2) << other.err;
  EXPECT_EQ(lines_with(other.err, "was started as `semfield train " + config + " --out " + dir / "a" +
                                      " --steps 9`, and rank 0 as `semfield train " + config + " --out " + dir / "a" +
                                      "`; start all processes of a run with the same words"),
            1)
      << other.err;
  EXPECT_FALSE(fs::exists(dir / "a"));
  const Result unknown = both({"train", config, "--out", dir / "b"}, {"train", config, "--stepz", "9"});
  EXPECT_NE(unknown.code, 0);
  EXPECT_EQ(lines_with(unknown.err, "semfield: train has no flag --stepz"), 1) << unknown.err;
}

}  // namespace
}  // namespace semfield
