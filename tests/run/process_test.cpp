// The real program, killed and signalled: no run is lost and resumed ones end in the same bits; lines of its verbs.

#include <poll.h>
#include <pty.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <cstdio>
#include <nlohmann/json.hpp>

#include "app/terminal.h"
#include "core/rng.h"
#include "execution/device_library.h"
#include "formats/safetensors.h"
#include "report/report.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using namespace app;
using namespace testing_program;

class Process : public testing_program::Process {
 public:
  Process(const std::vector<std::string>& words, const TempDir& dir)
      : testing_program::Process(program(), words, dir.path()) {}
};

Result run(const std::vector<std::string>& words, const TempDir& dir) { return Process(words, dir).wait(); }

// Of the newest checkpoint that a kill has left; -1: none. A damaged one is a failure.
std::int64_t newest_step(const std::string& run_dir) {
  if (!std::filesystem::exists(run_dir + "/checkpoints")) return -1;
  Diagnostics diagnostics;
  const auto newest = CheckpointStore::read(run_dir + "/checkpoints").find_latest(diagnostics);
  EXPECT_TRUE(diagnostics.all().empty()) << diagnostics.all().front().text();
  return newest ? newest->step : -1;
}

TEST(Process, RandomKillsLoseNoRunAndChangeNoBit) {
  const TempDir dir;
  const int steps = 200;
  const char* const asked = std::getenv("SEMFIELD_TORTURE_KILLS");
  const int wanted = asked != nullptr ? std::max(1, std::atoi(asked)) : 50;
  write_packed_config(dir, steps, 0.02);
  // Small steps: a thousand kills are about starts, saves and resumes.
  const std::string config = dir / "small.yaml", victim = dir / "victim";
  write_file_atomic(config, "include: config.yaml\ntrain: {rays: 24}\nruntime: {threads: 1}\n");
  const auto start = std::chrono::steady_clock::now();
  ASSERT_EQ(run({"train", config, "--out", dir / "whole"}, dir).code, 0);
  const double whole_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  const std::uint32_t whole = checkpoint_fingerprint(dir / "whole", steps);
  const auto words = [&] {
    return std::filesystem::exists(victim + "/run.yaml") ? std::vector<std::string>{"train", "--resume", victim}
                                                         : std::vector<std::string>{"train", config, "--out", victim};
  };
  int kills = 0;
  std::int64_t step = -1;
  for (int attempt = 0; kills < wanted && attempt < 10 * wanted; ++attempt) {
    Process process(words(), dir);
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
      continue;
    }
    const std::int64_t left = newest_step(victim);
    EXPECT_GE(left, step) << "kill " << kills << " lost a checkpoint";
    ++kills;
    step = left;
  }
  EXPECT_EQ(kills, wanted);
  (void)succeeded(run(words(), dir));
  EXPECT_EQ(checkpoint_fingerprint(victim, steps), whole);
  for (const auto& entry : std::filesystem::recursive_directory_iterator(victim))
    EXPECT_NE(entry.path().extension(), ".tmp");
}

TEST(Process, EvalPrintsOneJsonObject) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 30, 0);
  ASSERT_EQ(run({"train", config, "--out", dir / "run"}, dir).code, 0);
  const Result r = succeeded(run({"--json", "eval", dir / "run"}, dir));
  for (const char* name : {"\"miou_present\":", "\"total_accuracy\":", "\"psnr\":", "\"absrel\":", "\"train_s\":",
                           "\"entropy_auroc\":", "\"auroc_error\":"}) {
    EXPECT_HAS(r.out, name) << name << " in " << r.out;
  }
  EXPECT_EQ(std::count(r.out.begin(), r.out.end(), '\n'), 1);
  EXPECT_LACKS(r.out, "given_right_entropy");
  const Result trained = succeeded(run({"--json", "eval", dir / "run", "--split", "train"}, dir));
  for (const char* name : {"\"given_right_entropy\":1.", "\"given_wrong_auroc\":null"})
    EXPECT_HAS(trained.out, name) << name << " in " << trained.out;
  const Result rendered = succeeded(run({"render", dir / "run", "--split", "test", "--npy"}, dir));
  EXPECT_HAS(rendered.out, "frames=3");
}

TEST(Process, AStepOfDepthPicturesSuitsTheSceneAndIsSaid) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  for (const auto& [scale, step] : {std::pair{"1", "0.001"}, {"300", "0.1"}}) {
    const std::string out = dir / scale, factor = std::string("=") + scale;
    ASSERT_EQ(run({"train", config, "--set", "scene.load.pose_scale" + factor, "--set",
                   "scene.load.depth_scale" + factor, "--out", out},
                  dir)
                  .code,
              0);
    const Result rendered = succeeded(run({"render", out, "--split", "test", "--out", out + "_views"}, dir));
    EXPECT_HAS(read_text_file(out + "_views/cameras.json"), std::string("\"depth_step\": ") + step + ",\n");
    EXPECT_EQ(rendered.err.find("a step of the depth pictures is 0.1 ") != std::string::npos, step[2] == '1')
        << rendered.err;
  }
}

// A figure that is a length has its digits in a scene of any unit.
TEST(Process, FiguresOfATinySceneAreNotPrintedAsNought) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  ASSERT_EQ(run({"train", config, "--set", "scene.load.pose_scale=1e-4", "--set", "scene.load.depth_scale=1e-4",
                 "--out", dir / "run"},
                dir)
                .code,
            0);
  const Result plan = succeeded(
      run({"train", config, "--set", "scene.load.pose_scale=1e-4", "--set", "scene.load.depth_scale=1e-4", "--dry-run"},
          dir));
  EXPECT_HAS(plan.out, "bounds    0.000");
  const Result eval = succeeded(run({"eval", dir / "run"}, dir));
  const Result json = succeeded(run({"eval", dir / "run", "--json"}, dir));
  for (const std::string name : {"absdiff", "sqrel", "rmse"}) {
    const std::size_t at = eval.out.find("  " + name + " ");
    ASSERT_NE(at, std::string::npos) << eval.out;
    const double meant = nlohmann::json::parse(json.out)[name].get<double>();
    ASSERT_LT(meant, 1e-3) << name;
    EXPECT_NEAR(std::stod(eval.out.substr(at + 3 + name.size())), meant, 1e-3 * meant) << name;
  }
}

// What is wrong with words and configurations: tests/bad_files.
TEST(Process, ARefusedRunLeavesNoFolder) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 5, 0);
  std::string why_not;  // this build or this machine has none
  if (!cuda_available(&why_not)) {
    EXPECT_ENDED(run({"train", config, "--set", "runtime.device=cuda", "--out", dir / "x"}, dir), 69, why_not);
  }
  EXPECT_EQ(run({"train", config, "--out", "/proc/semfield"}, dir).code, 73);
  EXPECT_EQ(run({"train", config, "--set", "passes.0.field.type=tiny_mpl", "--out", dir / "x"}, dir).code, 78);
  EXPECT_FALSE(std::filesystem::exists(dir / "x"));
}

// The program's words about scores: those of a sample cannot be taken for those of the split.

using ScoreLines = ProgramInAFolder;

TEST_F(ScoreLines, ASampleHasNamesOfItsOwn) {
  write_packed_config(dir, 200, 60);
  // A time that the first step exceeds leaves time for the least evaluation.
  const Result cut = succeeded(semfield("train config.yaml --time 0.001s --threads 1 --out cut"));
  EXPECT_EQ(cut.out.find("train: sample=3/3 sample_pixels=1/"), 0u) << cut.out;
  EXPECT_HAS(cut.out, " sample_miou_present=0.");
  EXPECT_LACKS(cut.out, " miou_present=", " total_accuracy=", " psnr=", " absrel=");
  EXPECT_HAS(cut.err, "the last evaluation scores all 3 frames at 1 pixel in ",
             " to end near the time asked for (report.eval_share 0.1); `semfield eval cut` scores every pixel");
  EXPECT_HAS(read_text_file(dir / "cut/report.html"), "\"split\":\"test_sample\"");
  const Result eval = semfield("eval cut");
  EXPECT_EQ(eval.out.find("cut: 3 test frames, step "), 0u) << eval.out;

  const Result whole =
      succeeded(semfield("train config.yaml --time 0.001s --set report.eval_share=0 --threads 1 --out whole -q"));
  EXPECT_EQ(whole.out.find("train: miou_present=0."), 0u) << whole.out;
  EXPECT_EQ(whole.err, "") << "-q";
}

// What `eval` found is what the report shows from then on, once however often it ran.
TEST_F(ScoreLines, EvalKeepsItsScoresForTheReport) {
  write_packed_config(dir, 200, 60);
  ASSERT_EQ(semfield("train config.yaml --time 0.001s --threads 1 --out run -q").code, 0);
  const auto evals = [&] {
    std::vector<MetricsRow> rows = read_metrics(dir / "run/metrics.jsonl");
    std::erase_if(rows, [](const MetricsRow& row) { return row.kind != "eval"; });
    return rows;
  };
  ASSERT_EQ(evals().size(), 1u);
  const Result eval = succeeded(semfield("eval run --json"));
  const nlohmann::json found = nlohmann::json::parse(eval.out);
  ASSERT_EQ(semfield("eval run -q").code, 0);
  ASSERT_EQ(evals().size(), 2u) << "the same scores are kept once";
  const MetricsRow kept = evals().back();
  EXPECT_EQ(kept.split, "test");
  EXPECT_EQ(kept.step, found["step"].get<std::int64_t>());
  EXPECT_EQ(kept.get("psnr"), found["psnr"].get<double>());
  EXPECT_EQ(kept.get("frames"), 3);
  EXPECT_EQ(kept.get("pixels"), found["pixels"].get<double>());
  EXPECT_HAS(read_text_file(dir / "run/final_eval.json"), "\"split\":\"test\"");
  ASSERT_EQ(semfield("report run").code, 0);
  const nlohmann::json shown = nlohmann::json::parse(read_report({dir / "run"}));
  EXPECT_EQ(shown["runs"][0]["rows"].back()["split"], "test") << "all frames, no sample";
  // A run that has ended prints what its folder holds.
  const Result again = semfield("train --resume run --threads 1");
  EXPECT_EQ(again.out.find("train: miou_present="), 0u) << again.out;
  // Figures of other settings are not the run's.
  const Result other = succeeded(semfield("eval run --set scene.load.width_px=24 --set scene.load.height_px=18"));
  EXPECT_HAS(other.err, "the run's folder does not keep these scores");
  EXPECT_EQ(evals().size(), 2u);
  // Colours from poses that fit the field stand beside the plain figure.
  const Result fitted = succeeded(semfield("eval run --refine-poses --json"));
  const nlohmann::json refined = nlohmann::json::parse(fitted.out)["refined_poses"];
  EXPECT_EQ(evals().back().get("psnr_refined_poses"), refined["psnr"].get<double>());
}

TEST_F(ScoreLines, FiguresThatTheSceneCannotHaveAreNotPrinted) {
  write_packed_config(dir, 2, 60);
  const Result r = succeeded(semfield("train config.yaml --set scene.labels.frames=none --threads 1 --out run"));
  EXPECT_EQ(r.out.find("train: psnr="), 0u) << r.out;
  EXPECT_HAS(r.out, " absrel=");
  EXPECT_LACKS(r.out, "=-");
}

TEST(Findings, WhatTrainingHasShownIsNotSaidAgain) {
  const TempDir dir;
  write_packed_config(dir, 2, 60);
  const std::string warning = "the size asked for changes the aspect ratio";
  const Result trained = succeeded(
      semfield_run("train config.yaml --set scene.load.width_px=20 --set scene.load.height_px=36 --threads 1 --out run",
                   dir.path()));
  EXPECT_HAS(trained.err, warning);
  for (const char* verb : {"eval run", "render run"}) {
    const Result r = succeeded(semfield_run(verb, dir.path()));
    EXPECT_LACKS(r.err, warning) << verb << "\n" << r.err;
  }
  std::filesystem::remove(dir / "run/findings.txt");
  EXPECT_HAS(semfield_run("eval run", dir.path()).err, warning);
}

// What long work says of itself: one line on a terminal, one every two seconds elsewhere, none when quiet.

// Everything written while `done` goes from 0 to 4 frames, a second each, shown at every half.
std::string written(bool terminal, bool quiet, double second = 1, int columns = 80) {
  AppContext context;
  context.terminal = terminal;
  context.quiet = quiet;
  double now_s = 100;
  std::string out;
  {
    ProgressLine line(
        context, "scored", "frames",
        {[&] { return now_s; }, [&](const std::string& text) { out += terminal ? "<" + text + ">" : text + "\n"; },
         [=] { return columns; }});
    for (int half = 1; half <= 8; ++half) {
      now_s += second / 2;
      line.show(half / 2.0, 4);
    }
  }
  return out;
}

TEST(ProgressLine, ALineEveryTwoSecondsWhereLinesStay) {
  EXPECT_EQ(written(false, false), "scored 2/4 frames, 0:02 left\nscored 4/4 frames\n");
  EXPECT_EQ(written(false, false, 0.4), "") << "short work leaves no line";
  EXPECT_EQ(written(false, false, 60).substr(0, 29), "scored 0/4 frames, 3:30 left\n");
}

TEST(ProgressLine, ANewPartHasAUnitOfItsOwn) {
  double now_s = 0;
  std::string out;
  AppContext context;
  ProgressLine line(context, "seen", "frames",
                    {[&] { return now_s; }, [&](const std::string& text) { out += text + "\n"; }});
  line.restart("learned", "steps");
  now_s += 2;
  line.show(5, 10);
  EXPECT_EQ(out, "learned 5/10 steps, 0:02 left\n");
}

TEST(ProgressLine, ATerminalsLineIsOverwrittenAndCleared) {
  const std::string out = written(true, false);
  EXPECT_EQ(out.find('\n'), std::string::npos);
  EXPECT_EQ(out.find("<scored 0/4 frames, 0:04 left><scored 1/4 frames, 0:03 left>"), 0u) << out;
  EXPECT_HAS(out, "<scored 4/4 frames><>");
  EXPECT_EQ(written(true, false, 1, 23).find("<scored 0/4, 0:04 left><scored 1/4, 0:03 left>"), 0u);
  EXPECT_EQ(written(true, false, 1, 20).find("<scored 0/4><scored 1/4>"), 0u);
}

TEST(ProgressLine, QuietIsSilent) {
  EXPECT_EQ(written(false, true), "");
  EXPECT_EQ(written(true, true), "");
}

// A run's files say what was trained, and the program says what does not go with them.

namespace fs = std::filesystem;

using RunTruth = ProgramInAFolder;

TEST_F(RunTruth, AFolderThatIsNoUtf8IsRefusedBeforeTraining) {
  const std::string folder = dir / "caf\xe9";
  fs::create_directory(folder);
  write_packed_config(dir, 5, 0);
  fs::copy(dir.path(), folder, fs::copy_options::none);  // files alone
  EXPECT_ENDED(semfield_run("train config.yaml --out run", folder), 78,
               "it is not UTF-8; nothing was written; give the folder or file another name", "caf\\xe9");
  EXPECT_FALSE(fs::exists(folder + "/run"));
  // Where only the run folder's name is none, the run's files hold no part of it.
  const Result named = succeeded(semfield("train config.yaml --threads 1 --out caf\xe9/run"));
  const Result json = succeeded(semfield("--json eval caf\xe9/run"));
}

TEST_F(RunTruth, SettingsOfAResumeAreStoredAndTold) {
  write_packed_config(dir, 5, 0);
  ASSERT_EQ(semfield("train config.yaml --threads 1 --out run").code, 0);
  const Result more = succeeded(semfield("train --resume run --set train.steps=9 --set report.strips=1"));
  EXPECT_HAS(more.err, "from step 5 on: train.steps: 5 -> 9");
  const std::string yaml = read_text_file((dir / "run") + "/run.yaml");
  EXPECT_HAS(yaml, "\n  steps: 9\n", "\n  strips: 1\n");
  // The next resume reads what the last one was given, and the report shows both.
  const Result again = succeeded(semfield("train --resume run --set train.steps=12"));
  EXPECT_HAS(again.err, "from step 9 on: train.steps: 9 -> 12");
  EXPECT_LACKS(again.err, "strips");
  const std::vector<std::string> changes =
      parse_settings_changed(read_text_file((dir / "run") + "/environment.json"), "environment.json");
  EXPECT_EQ(changes, (std::vector<std::string>{"step 5: train.steps: 5 -> 9", "step 5: report.strips: 0 -> 1",
                                               "step 9: train.steps: 9 -> 12"}));
  EXPECT_HAS(read_text_file((dir / "run") + "/report.html"), "step 9: train.steps");
  // A run.yaml that says something else than its checkpoint, as earlier versions left them.
  std::string other = yaml;
  other.replace(other.find("\n  rays: "), 9, "\n  rays: 1");
  write_file_atomic((dir / "run") + "/run.yaml", other);
  const Result refused = semfield("train --resume run");
  EXPECT_EQ(refused.code, 78) << refused.err;
  const std::size_t at = refused.err.find("semfield train --resume run --set train.rays=");
  ASSERT_NE(at, std::string::npos) << refused.err;
  const std::string words = refused.err.substr(at + 9, refused.err.find(';', at) - at - 9);
  EXPECT_EQ(semfield(words).code, 0) << "the remedy does what it says: " << words;
}

// From another working folder too, and they stay found. What is said of them: tests/bad_files/runs.cases.
TEST_F(RunTruth, MovedDataAreNamedOnTheCommandLine) {
  write_packed_config(dir, 5, 0);
  ASSERT_EQ(semfield("train config.yaml --threads 1 --out run").code, 0);
  fs::create_directory(dir / "elsewhere");
  fs::rename(dir / "room.sfpack", dir / "elsewhere/moved.sfpack");
  for (const char* words : {"eval ../run", "train --resume ../run"})
    (void)succeeded(semfield_run(words + std::string(" --set scene.file=moved.sfpack"), dir / "elsewhere"));
  (void)succeeded(semfield("eval run"));
}

TEST_F(RunTruth, RunsEqualComparesWhatWasTrained) {
  write_packed_config(dir, 8, 0);
  const auto train = [&](const std::string& name, const std::string& more) {
    const Result r = succeeded(semfield("train config.yaml --out " + name + " " + more));
  };
  train("a", "--threads 1");
  train("b", "--threads 2 --set report.log_every_steps=3 --memory 100");
  train("seed", "--threads 1 --set runtime.seed=7");
  train("longer", "--threads 1 --steps 9");
  const auto compare = [&](const std::string& other, int code, const std::string& said) {
    const Result r = semfield("runs equal a " + other);
    EXPECT_EQ(r.code, code) << r.err;
    EXPECT_EQ(r.out.substr(0, said.size()), said);
  };
  compare("b", 0, "runs: equal step=8 tensors=");
  compare("seed", 1, "runs: different: runtime.seed: 1 -> 7\n");
  compare("longer", 1, "runs: different: step: 8 -> 9\n");
  // Equal runs have the same identity, whatever their threads.
  const auto hash_of = [&](const std::string& name) {
    return TensorFile::read(dir / (name + "/checkpoints/step_00000008.safetensors")).metadata().at("config_hash");
  };
  EXPECT_EQ(hash_of("a"), hash_of("b"));
  EXPECT_NE(hash_of("a"), hash_of("seed"));
  const std::string path = dir / "b/checkpoints/step_00000008.safetensors";
  const TensorFile file = TensorFile::read(path);
  std::vector<TensorRef> tensors = file.tensors();
  std::vector<std::byte> bytes(tensors[1].bytes.begin(), tensors[1].bytes.end());
  bytes[8] ^= std::byte{1};  // the lowest bit of element 2
  tensors[1].bytes = bytes;
  write_safetensors(path, tensors, file.metadata());
  compare("b", 1, "runs: different: tensor '" + tensors[1].name + "' differs from element 2 on\n");
  EXPECT_EQ(semfield("runs equal a nowhere").code, 66);
}

// What helps a run over a step that fails may change; the remedy of such a step says so.
TEST_F(RunTruth, AResumeMayTakeAnotherSeedOrLearningRate) {
  write_packed_config(dir, 3, 0);
  ASSERT_EQ(semfield("train config.yaml --threads 1 --out run").code, 0);
  const Result r =
      succeeded(semfield("train --resume run --steps 5 --set runtime.seed=4 --set train.adam.learning_rate=0.001"));
  EXPECT_HAS(r.err, "from step 3 on: runtime.seed: 1 -> 4");
  EXPECT_EQ(semfield("train --resume run --steps 6").code, 0) << "and it stays so";
}

// What people see on a terminal: a live line within its width, which leaves nothing behind, and notes of whole words.

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
