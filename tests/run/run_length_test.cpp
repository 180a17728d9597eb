// The length of a run: stated in steps or in seconds, settled, stored, repeated and gone on with. Clocks are
// counted.
#include "config/compose.h"
#include "run/run_loop.h"
#include "session/settings/choices.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
namespace fs = std::filesystem;

constexpr double kStep_s = 0.25;

/// Every step takes `step_s()` by this clock.
class CountedSteps final : public RunListener {
 public:
  std::function<double(std::int64_t)> step_s = [](std::int64_t) { return kStep_s; };
  std::function<int(std::int64_t)> signal_at = [](std::int64_t) { return 0; };
  std::function<bool(std::int64_t)> save_at = [](std::int64_t) { return false; };
  bool reports = false;
  std::string notes;

  double step_clock_s() override {
    if (begun_) now_s_ += step_s(step_);
    begun_ = !begun_;
    return now_s_;
  }
  void stepped(std::int64_t step, const StepLosses&) override { step_ = step; }
  int stop_signal() override { return signal_at(step_); }
  bool save_request() override { return save_at(step_); }
  void note(const std::string& text) override { notes += text + "\n"; }
  std::string write_report(const RunFolder& folder, const Session&, const ReportFrames&) override {
    if (!reports) return "";
    write_file_atomic(folder.report_path(), "page\n");
    return folder.report_path();
  }

 private:
  bool begun_ = false;
  double now_s_ = 0;
  std::int64_t step_ = 0;
};

class RunLengthTest : public ::testing::Test {
 protected:
  RunConfig config(const std::string& more = "") {
    Diagnostics diagnostics;
    RunConfig read = read_run_config(
        parse_config_text(hash_config("report: {eval_every_s: 0, checkpoint_every_s: 0}\n" + more), "test.yaml"),
        registry_, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    return read;
  }
  RunConfig stored(const std::string& run) { return load_run_config(dir_ / run + "/run.yaml", {}, registry_); }
  RunConfig asked(const AskedLength& length, const std::string& more = "") {
    RunConfig made = config(more);
    ask(made, length);
    return made;
  }
  TrainOutcome train(RunConfig config, const std::string& run, RunListener& listener) {
    TrainRequest request{.out_dir = dir_ / run};
    return run_training(std::move(config), registry_, request, &listener);
  }
  TrainOutcome resume(const std::string& run, const AskedLength& more, RunListener& listener) {
    TrainRequest request{.out_dir = dir_ / run, .resume = true, .more = more};
    return run_training(stored(run), registry_, request, &listener);
  }
  std::uint32_t bits(const std::string& run, std::int64_t step) { return checkpoint_fingerprint(dir_ / run, step); }
  void copy_as_a_kill_leaves_it(const std::string& from, const std::string& to) {
    fs::copy(dir_ / from, dir_ / to, fs::copy_options::recursive);
    fs::remove(dir_ / to + "/.lock");
  }

  TempDir dir_;
  Registry registry_ = make_registry();
};

TEST_F(RunLengthTest, ATimeIsSettledStoredAndRepeatedByNumbers) {
  CountedSteps clock;
  const TrainOutcome timed =
      train(asked({0, 20}, "losses: [{type: distortion, weight: 0.1, from_step: 0.05}]\n"), "timed", clock);
  EXPECT_EQ(timed.step, 80);
  EXPECT_NEAR(timed.train_s, 20, 0.01);
  EXPECT_EQ(timed.trained_s, timed.train_s);
  EXPECT_HAS(clock.notes, "the length is settled: 80 steps for 20 s of training");
  const RunConfig settled = stored("timed");
  EXPECT_EQ(settled.train.steps, 80);
  EXPECT_EQ(settled.train.time_s, 20);
  EXPECT_EQ(settled.schedule.decay_steps, 80);
  EXPECT_GE(settled.schedule.hold_steps, 8);
  EXPECT_LE(settled.schedule.hold_steps, 12);
  EXPECT_TRUE(settled.schedule.legs.empty());
  EXPECT_NEAR(schedule_factor(settled.schedule, last_step(settled)), settled.schedule.factor, 1e-15);
  // Another machine, by the numbers alone.
  CountedSteps slow;
  slow.step_s = [](std::int64_t step) { return step < 40 ? 3.0 : 1.0; };
  EXPECT_EQ(train(stored("timed"), "again", slow).step, 80);
  EXPECT_LACKS(slow.notes, "settled");
  EXPECT_EQ(bits("again", 80), bits("timed", 80));
}

TEST_F(RunLengthTest, ARateThatChangesIsSettledAnewAndRepeatedByNumbers) {
  CountedSteps clock;
  clock.step_s = [](std::int64_t step) { return step < 60 ? 0.2 : 0.1; };
  const TrainOutcome timed = train(asked({0, 20}), "timed", clock);
  EXPECT_NEAR(timed.train_s, 20, 1.7);
  EXPECT_LACKS(clock.notes, "settled again");
  EXPECT_EQ(clock.notes.find("is settled"), clock.notes.rfind("is settled")) << "said once: " << clock.notes;
  const RunConfig settled = stored("timed");
  EXPECT_FALSE(settled.schedule.legs.empty());
  EXPECT_EQ(last_step(settled), timed.step);
  for (std::int64_t step = settled.schedule.hold_steps + 1; step < timed.step; ++step)
    ASSERT_LE(schedule_factor(settled.schedule, step), schedule_factor(settled.schedule, step - 1)) << step;
  CountedSteps other;
  train(stored("timed"), "again", other);
  EXPECT_EQ(bits("again", timed.step), bits("timed", timed.step));
}

TEST_F(RunLengthTest, ARunKilledOrStoppedBeforeItIsSettledTrainsWhatWasAskedFor) {
  CountedSteps clock;
  clock.save_at = [&](std::int64_t step) {
    if (step == 5) copy_as_a_kill_leaves_it("stopped", "killed");
    return false;
  };
  clock.signal_at = [](std::int64_t step) { return step == 6 ? 2 : 0; };
  EXPECT_EQ(train(asked({0, 20}), "stopped", clock).step, 6);
  EXPECT_EQ(stored("stopped").train.steps, 0);
  for (const char* run : {"stopped", "killed"}) {
    CountedSteps later;
    const TrainOutcome ended = resume(run, {}, later);
    EXPECT_EQ(ended.step, 80) << run;
    EXPECT_NEAR(ended.train_s, 20, 0.01) << run;
    EXPECT_LACKS(later.notes, " on: ");
  }
}

TEST_F(RunLengthTest, ARunKilledAfterItWasSettledEndsWithTheBitsOfOneLeftAlone) {
  CountedSteps clock;
  clock.save_at = [&](std::int64_t step) {
    if (step == 40) copy_as_a_kill_leaves_it("timed", "killed");
    return step == 5;
  };
  EXPECT_EQ(train(asked({0, 20}), "timed", clock).step, 80);
  CountedSteps later;
  later.step_s = [](std::int64_t) { return 7.0; };
  EXPECT_EQ(resume("killed", {}, later).step, 80);
  EXPECT_HAS(later.notes, "resuming at step 5 ");
  EXPECT_LACKS(later.notes, " on: ") << "what was settled is no change: " << later.notes;
  EXPECT_EQ(bits("killed", 80), bits("timed", 80));
}

TEST_F(RunLengthTest, AResumeTrainsThatMuchMoreAtAUsefulRate) {
  CountedSteps clock;
  train(asked({40, 0}), "run", clock);
  copy_as_a_kill_leaves_it("run", "cut");
  CountedSteps more;
  const TrainOutcome ended = resume("run", {30, 0}, more);
  EXPECT_EQ(ended.step, 70);
  EXPECT_NEAR(ended.trained_s, 30 * kStep_s, 1e-9);
  EXPECT_HAS(more.notes, "from step 40 on: length: 40 steps -> 70 steps");
  const ScheduleParams schedule = stored("run").schedule;
  EXPECT_NEAR(schedule_factor(schedule, 39), std::pow(0.1, 39.0 / 40), 1e-12);
  EXPECT_EQ(schedule_factor(schedule, 40), 0.5);
  EXPECT_NEAR(schedule_factor(schedule, 70), 0.1, 1e-12);
  // Cut off within the leg, and trained anew by the numbers: the same bits.
  CountedSteps cut;
  cut.signal_at = [](std::int64_t step) { return step == 52 ? 15 : 0; };
  EXPECT_EQ(resume("cut", {30, 0}, cut).step, 52);
  CountedSteps rest;
  EXPECT_EQ(resume("cut", {}, rest).step, 70);
  EXPECT_EQ(bits("cut", 70), bits("run", 70));
  CountedSteps anew;
  train(stored("run"), "anew", anew);
  EXPECT_EQ(bits("anew", 70), bits("run", 70));
}

TEST_F(RunLengthTest, AResumeForATimeTrainsThatLongMore) {
  CountedSteps clock;
  train(asked({40, 0}), "run", clock);
  CountedSteps more;
  more.signal_at = [](std::int64_t step) { return step == 42 ? 2 : 0; };
  EXPECT_EQ(resume("run", {0, 20}, more).step, 42);
  EXPECT_EQ(last_step(stored("run")), 0) << "not settled yet";
  CountedSteps rest;
  const TrainOutcome ended = resume("run", {}, rest);
  EXPECT_EQ(ended.step, 120);
  EXPECT_NEAR(ended.train_s, 40 * kStep_s + 20, 0.01);
  CountedSteps anew;
  train(stored("run"), "anew", anew);
  EXPECT_EQ(bits("anew", 120), bits("run", 120));
}

TEST_F(RunLengthTest, MoreIsCountedFromTheStepThatIsResumed) {
  CountedSteps clock;
  clock.signal_at = [](std::int64_t step) { return step == 10 ? 2 : 0; };
  train(asked({40, 0}), "run", clock);
  CountedSteps more;
  EXPECT_EQ(resume("run", {25, 0}, more).step, 35) << "in place of what was left";
  const ScheduleParams schedule = stored("run").schedule;
  EXPECT_EQ(schedule_factor(schedule, 10), std::pow(0.1, 10.0 / 40)) << "the rate goes on, for it is above a half";
}

// Without the lock, which says who held the folder last.
std::map<std::string, std::pair<std::string, fs::file_time_type>> contents(const std::string& folder) {
  std::map<std::string, std::pair<std::string, fs::file_time_type>> files;
  for (const fs::directory_entry& entry : fs::recursive_directory_iterator(folder))
    if (entry.is_regular_file() && entry.path().filename() != ".lock")
      files[entry.path().string()] = {read_text_file(entry.path().string()), entry.last_write_time()};
  return files;
}

TEST_F(RunLengthTest, AResumeWithNothingToTrainChangesNoFile) {
  CountedSteps clock;
  clock.reports = true;
  const TrainOutcome ended = train(asked({20, 0}), "run", clock);
  const auto before = contents(dir_ / "run");
  CountedSteps nothing;
  nothing.reports = true;
  const TrainOutcome again = resume("run", {}, nothing);
  EXPECT_EQ(contents(dir_ / "run"), before);
  EXPECT_HAS(nothing.notes,
             "the run has come to its end, 20 steps, and nothing of it was changed; to train on: "
             "`semfield train --resume " +
                 (dir_ / "run") + " --time 5s`");
  EXPECT_EQ(again.trained_s, 0);
  EXPECT_EQ(again.step, 20);
  EXPECT_EQ(again.values, ended.values);
  EXPECT_EQ(again.scored.frames, ended.scored.frames);
  EXPECT_EQ(again.report_path, ended.report_path);
  // What it says works.
  CountedSteps more;
  more.reports = true;
  EXPECT_EQ(resume("run", {0, 5}, more).step, 40);
  // A run whose page or last figures are missing gets them.
  fs::remove(dir_ / "run/final_eval.json");
  fs::remove(dir_ / "run/report.html");
  CountedSteps cut_off;
  cut_off.reports = true;
  EXPECT_EQ(resume("run", {}, cut_off).step, 40);
  EXPECT_TRUE(fs::exists(dir_ / "run/final_eval.json") && fs::exists(dir_ / "run/report.html"));
}

TEST_F(RunLengthTest, AProgramThatDrivesARunHasTheSameLength) {
  CountedSteps clock;
  RunSessionOptions options{.run_dir = dir_ / "driven"};
  {
    RunSession run(asked({0, 20}), registry_, options, clock);
    while (!run.training().at_its_end()) run.advance(1000);
    EXPECT_EQ(run.training().step(), 80);
    run.save("");
  }
  CountedSteps again;
  train(stored("driven"), "again", again);
  EXPECT_EQ(bits("again", 80), bits("driven", 80));
}

TEST_F(RunLengthTest, TheDeviceSettlesALengthThatNobodyAskedFor) {
  for (const auto& [device, steps] : {std::pair{Device::cpu, kStepsOnCpu}, std::pair{Device::cuda, kStepsOnGpu}}) {
    RunConfig open = config();
    open.train.steps = open.schedule.decay_steps = 0;
    EXPECT_HAS(resolve_length(open, device), std::to_string(steps) + " steps");
    EXPECT_EQ(last_step(open), steps);
    EXPECT_EQ(open.schedule.decay_steps, steps);
    RunConfig fixed = config();
    EXPECT_EQ(resolve_length(fixed, device), "");
    EXPECT_EQ(fixed.schedule.decay_steps, 250000) << "what is written stays";
  }
  for (const char* preset : {"room", "object", "unbounded"}) {
    const ConfigNode tree =
        compose_config(std::string(SEMFIELD_SOURCE_DIR) + "/configs/presets/" + preset + ".yaml", {});
    EXPECT_EQ(tree.find("train")->find("steps")->text(), "0") << preset;
    EXPECT_EQ(tree.find("train")->find("schedule")->find("decay_steps")->text(), "0") << preset;
  }
}

TEST_F(RunLengthTest, WhatNeverWorksInARunOfItsLengthIsRefused) {
  const auto said = [&](const std::string& more) -> std::string {
    RunConfig read = config(more);
    read.train.steps = 100;
    try {
      CountedSteps clock;
      train(std::move(read), "refused", clock);
    } catch (const Error& error) {
      EXPECT_FALSE(fs::exists(dir_ / "refused"));
      return error.what();
    }
    return "nothing";
  };
  EXPECT_HAS(said("losses: [{type: distortion, from_step: 1}]\n"),
             "the term 'distortion' never works: its from_step 1 is the end of the run of 100 steps");
  EXPECT_HAS(said("losses: [{type: distortion, from_step: 0.995}]\n"), "never works");
  RunConfig warm = config();
  warm.schedule.warmup_steps = warm.train.steps;
  Diagnostics never;
  check_length(warm, never);
  EXPECT_EQ(never.error_count(), 1);
  --warm.schedule.warmup_steps;
  Diagnostics fine;
  check_length(warm, fine);
  EXPECT_FALSE(fine.has_errors());
}

TEST_F(RunLengthTest, RunsOfEarlierVersionsKeepTheirStepsAndFilesOfTheirOwnAreTold) {
  CountedSteps clock;
  train(asked({10, 0}), "old", clock);
  std::string yaml = read_text_file(dir_ / "old/run.yaml");
  yaml.replace(yaml.find("time_s: 0.0"), 11, "time_limit_s: 85.0");
  write_file_atomic(dir_ / "old/run.yaml", yaml);
  const RunConfig read = stored("old");
  EXPECT_EQ(read.train.steps, 10);
  EXPECT_EQ(read.train.time_s, 85);
  EXPECT_HAS(error_of([&] {
               (void)run_config_of(parse_config_text(hash_config(), "own.yaml")
                                       .with("train", parse_config_text("{time_limit_s: 60}", "own.yaml")),
                                   registry_);
             }),
             "write train: {steps: 0, time_s: SECONDS}");
}

}  // namespace
}  // namespace semfield
