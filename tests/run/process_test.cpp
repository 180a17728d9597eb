// The real program, killed and signalled: no run is lost and resumed ones end in the same bits; lines of its verbs.
#include <signal.h>

#include <cstdio>
#include <nlohmann/json.hpp>

#include "app/terminal.h"
#include "core/rng.h"
#include "execution/device_library.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "system/files.h"
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
  Remains found{.begun = std::filesystem::exists(run_dir + "/run.yaml")};
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
  for (int i = 0; i < 12000 && !std::filesystem::exists((dir / "run") + "/metrics.jsonl"); ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  std::this_thread::sleep_for(std::chrono::milliseconds(200));
  process.send(signal);
  const Result r = process.wait();
  EXPECT_EQ(r.code, code) << r.err;
  EXPECT_HAS(r.err, "semfield train --resume");
  const Result resumed = run({"train", "--resume", dir / "run", "--time", "1s"}, dir);
  EXPECT_EQ(resumed.code, 0) << resumed.err;
  EXPECT_HAS(resumed.err, "resuming at step");
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
    EXPECT_HAS(r.out, name) << name << " in " << r.out;
  }
  EXPECT_EQ(std::count(r.out.begin(), r.out.end(), '\n'), 1);
  EXPECT_LACKS(r.out, "given_right_entropy");
  const Result trained = run({"--json", "eval", dir / "run", "--split", "train"}, dir);
  ASSERT_EQ(trained.code, 0) << trained.err;
  for (const char* name : {"\"given_right_entropy\":1.", "\"given_wrong_auroc\":null"})
    EXPECT_HAS(trained.out, name) << name << " in " << trained.out;
  const Result rendered = run({"render", dir / "run", "--split", "test", "--npy"}, dir);
  ASSERT_EQ(rendered.code, 0) << rendered.err;
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
    const Result rendered = run({"render", out, "--split", "test", "--out", out + "_views"}, dir);
    ASSERT_EQ(rendered.code, 0) << rendered.err;
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
  const Result plan =
      run({"train", config, "--set", "scene.load.pose_scale=1e-4", "--set", "scene.load.depth_scale=1e-4", "--dry-run"},
          dir);
  ASSERT_EQ(plan.code, 0) << plan.err;
  EXPECT_HAS(plan.out, "bounds    0.000");
  const Result eval = run({"eval", dir / "run"}, dir);
  ASSERT_EQ(eval.code, 0) << eval.err;
  const Result json = run({"eval", dir / "run", "--json"}, dir);
  ASSERT_EQ(json.code, 0) << json.err;
  for (const std::string name : {"absdiff", "sqrel", "rmse"}) {
    const std::size_t at = eval.out.find("  " + name + " ");
    ASSERT_NE(at, std::string::npos) << eval.out;
    const double meant = nlohmann::json::parse(json.out)[name].get<double>();
    ASSERT_LT(meant, 1e-3) << name;
    EXPECT_NEAR(std::stod(eval.out.substr(at + 3 + name.size())), meant, 1e-3 * meant) << name;
  }
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
      // Before the scene is read, which may take minutes: here it is not even there.
      {{"train", config, "--set", "scene.file=" + (dir / "none.sfpack"), "--out", dir / "run"},
       73,
       "holds files already; continue that run with `semfield train --resume"},
      {{"train", dir / "absent.yaml"}, 66, "absent.yaml"},
      {{"train", bad_key, "--out", dir / "x"},
       78,
       "bad_key.yaml:2:13: semantics: unknown key 'wieght'; did you mean 'weight'?"},
      {{"train", bad_key, "--out", dir / "x"}, 78, "bad_key.yaml:3:15: train.rays: expected int, got 'many'"},
      {{"config", "check", bad_key, "--set", "train.stepps=1", "--set", "train"}, 78, "unknown key 'wieght'"},
      {{"config", "check", bad_key, "--set", "train.stepps=1", "--set", "train"}, 78, "did you mean 'steps'?"},
      {{"config", "check", bad_key, "--set", "train.stepps=1", "--set", "train"}, 78, "expected KEY=VALUE"},
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
    EXPECT_HAS(r.err, c.message) << "expected '" << c.message << "' in: " << r.err;
  }
  EXPECT_FALSE(std::filesystem::exists(dir / "x")) << "a refused run leaves no folder";
}

// The program's words about scores: those of a sample cannot be taken for those of the split.

TEST(ScoreLines, ASampleHasNamesOfItsOwn) {
  const TempDir dir;
  write_packed_config(dir, 200, 60);
  // A time that the first step exceeds leaves time for the least evaluation.
  const Result cut = semfield_run("train config.yaml --time 0.001s --threads 1 --out cut", dir.path());
  ASSERT_EQ(cut.code, 0) << cut.err;
  EXPECT_EQ(cut.out.find("train: sample=3/3 sample_pixels=1/"), 0u) << cut.out;
  EXPECT_HAS(cut.out, " sample_miou_present=0.");
  EXPECT_LACKS(cut.out, " miou_present=", " total_accuracy=", " psnr=", " absrel=");
  EXPECT_HAS(cut.err, "the last evaluation scores all 3 frames at 1 pixel in ",
             " to end near the time asked for (report.eval_share 0.1); `semfield eval cut` scores every pixel");
  EXPECT_HAS(read_text_file(dir / "cut/report.html"), "a sample, all 3 frames at 1 pixel in ");
  const Result eval = semfield_run("eval cut", dir.path());
  EXPECT_EQ(eval.out.find("cut: 3 test frames, step "), 0u) << eval.out;

  const Result whole =
      semfield_run("train config.yaml --time 0.001s --set report.eval_share=0 --threads 1 --out whole -q", dir.path());
  ASSERT_EQ(whole.code, 0) << whole.err;
  EXPECT_EQ(whole.out.find("train: miou_present=0."), 0u) << whole.out;
  EXPECT_EQ(whole.err, "") << "-q";
}

// What `eval` found is what the report shows from then on, once however often it ran.
TEST(ScoreLines, EvalKeepsItsScoresForTheReport) {
  const TempDir dir;
  write_packed_config(dir, 200, 60);
  ASSERT_EQ(semfield_run("train config.yaml --time 0.001s --threads 1 --out run -q", dir.path()).code, 0);
  const auto evals = [&] {
    std::vector<MetricsRow> rows = read_metrics(dir / "run/metrics.jsonl");
    std::erase_if(rows, [](const MetricsRow& row) { return row.kind != "eval"; });
    return rows;
  };
  ASSERT_EQ(evals().size(), 1u);
  const Result eval = semfield_run("eval run --json", dir.path());
  ASSERT_EQ(eval.code, 0) << eval.err;
  const nlohmann::json found = nlohmann::json::parse(eval.out);
  ASSERT_EQ(semfield_run("eval run -q", dir.path()).code, 0);
  ASSERT_EQ(evals().size(), 2u) << "the same scores are kept once";
  const MetricsRow kept = evals().back();
  EXPECT_EQ(kept.split, "test");
  EXPECT_EQ(kept.step, found["step"].get<std::int64_t>());
  EXPECT_EQ(kept.get("psnr"), found["psnr"].get<double>());
  EXPECT_EQ(kept.get("frames"), 3);
  EXPECT_EQ(kept.get("pixels"), found["pixels"].get<double>());
  EXPECT_HAS(read_text_file(dir / "run/final_eval.json"), "\"split\":\"test\"");
  ASSERT_EQ(semfield_run("report run", dir.path()).code, 0);
  EXPECT_HAS(read_text_file(dir / "run/report.html"), "; all 3 frames</div>");
  EXPECT_LACKS(read_text_file(dir / "run/report.html"), "Figures are of a sample");
  // A run that has ended prints what its folder holds.
  const Result again = semfield_run("train --resume run --threads 1", dir.path());
  EXPECT_EQ(again.out.find("train: miou_present="), 0u) << again.out;
  // Figures of other settings are not the run's.
  const Result other = semfield_run("eval run --set scene.load.width_px=24 --set scene.load.height_px=18", dir.path());
  EXPECT_EQ(other.code, 0) << other.err;
  EXPECT_HAS(other.err, "the run's folder does not keep these scores");
  EXPECT_EQ(evals().size(), 2u);
}

TEST(ScoreLines, FiguresThatTheSceneCannotHaveAreNotPrinted) {
  const TempDir dir;
  write_packed_config(dir, 2, 60);
  const Result r = semfield_run("train config.yaml --set scene.labels.frames=none --threads 1 --out run", dir.path());
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(r.out.find("train: psnr="), 0u) << r.out;
  EXPECT_HAS(r.out, " absrel=");
  EXPECT_LACKS(r.out, "=-");
}

TEST(Findings, WhatTrainingHasShownIsNotSaidAgain) {
  const TempDir dir;
  write_packed_config(dir, 2, 60);
  const std::string warning = "the size asked for changes the aspect ratio";
  const Result trained = semfield_run(
      "train config.yaml --set scene.load.width_px=20 --set scene.load.height_px=36 --threads 1 --out run", dir.path());
  ASSERT_EQ(trained.code, 0) << trained.err;
  EXPECT_HAS(trained.err, warning);
  for (const char* verb : {"eval run", "render run"}) {
    const Result r = semfield_run(verb, dir.path());
    EXPECT_EQ(r.code, 0) << r.err;
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

}  // namespace
}  // namespace semfield
