// Stopping, saving, loading and going on gives the bits of the run that was never stopped; other checkpoints are
// refused.

#include <cmath>
#include <nlohmann/json.hpp>

#include "config/settings/choices.h"
#include "eval/evaluator.h"
#include "eval/final_eval.h"
#include "tests/session/train_testing.h"
#include "train/metrics_log.h"
#include "train/run_folder.h"
#include "train/run_scores.h"

namespace semfield {
namespace {

using namespace testing_train;

TEST(Resume, AnotherNetworksCheckpointIsRefusedAndNothingChanges) {
  const TempDir dir;
  TestRun wide(hash_config());
  write_safetensors(dir / "state.safetensors", wide.trainer.tensors(), {});
  TestRun narrow(replaced(hash_config(), "color_width: 32", "color_width: 16"));
  const std::uint32_t before = narrow.bits();
  EXPECT_HAS(error_of(ErrorKind::data, [&] { narrow.trainer.load(TensorFile::read(dir / "state.safetensors"), 0); }),
             "another network's checkpoint");
  EXPECT_EQ(before, narrow.bits());
}

RunConfig config_of(const std::string& yaml, Registry& registry = all_plugins()) {
  return run_config_of(parse_config_text(yaml, "test.yaml"), registry);
}

TEST(TrainRun, WritesAWholeRunFolderAndEvaluatesFromIt) {
  const TempDir dir;
  TrainRequest request{.out_dir = dir / "run"};
  HookListener hooks;
  hooks.reports = true;
  const TrainOutcome outcome =
      run_training(config_of(hash_config("report: {eval_every_s: 0, strips: 2}\n")), all_plugins(), request, &hooks);
  EXPECT_EQ(outcome.step, 200);
  for (const char* file :
       {"run.yaml", "metrics.jsonl", "environment.json", "left_out.json", "classes.yaml", "report.html"})
    EXPECT_TRUE(std::filesystem::exists(request.out_dir + "/" + file)) << file;
  EXPECT_HAS(read_text_file(request.out_dir + "/environment.json"), "\"started\": \"20");
  double psnr = 0;
  for (const auto& [name, value] : outcome.values) {
    if (name == "psnr") psnr = *value;
  }
  const auto score_of = [](const Session& s) {
    return evaluate(*s.pipeline, s.eval_job(s.scene.frames_of(Split::test)), s.limits, s.plan.class_of_logit);
  };
  EXPECT_GT(psnr, *score_of(open_text(hash_config())).color.psnr_db() + 4) << "200 steps teach the room's colours";

  // Evaluating the folder gives the run's own last figures.
  Diagnostics diagnostics;
  OpenedRun opened = open_run(request.out_dir, {}, all_plugins(), diagnostics);
  const SplitScore score = score_of(opened.session);
  EXPECT_EQ(*score.color.psnr_db(), psnr);
  // What the run folder tells of its last evaluation is that evaluation.
  const auto read = [&](const char* name) { return nlohmann::json::parse(read_text_file(request.out_dir + name)); };
  const nlohmann::json stored = read("/final_eval.json"), labels = read("/labels.json");
  const auto again =
      nlohmann::json::parse(final_eval_json(score, opened.session.scene.info.classes, "test", 200, stored["train_s"]));
  for (const char* part : {"step", "confusion", "reliability", "entropy", "per_frame"})
    EXPECT_EQ(stored[part], again[part]) << part;
  EXPECT_EQ(labels["labelled_frames"], opened.session.manifest.labelled_frames);
  EXPECT_GT(labels["labelled_pixels"], 0);
  ReportFrames none({}, 0);
  for (const FrameScore& row : score.frames) none.add(row, {});
  EXPECT_TRUE(none.strips().empty() && none.worst().empty());
  ReportFrames frames({score.frames[0].frame}, 2);
  for (const FrameScore& row : score.frames) frames.add(row, {});
  EXPECT_EQ(frames.strips().size(), 1u);
  ASSERT_EQ(frames.worst().size(), std::min<std::size_t>(2, score.frames.size()));
  for (const FrameScore& row : score.frames) EXPECT_FALSE(row.worse_than(frames.worst()[0].first)) << row.name;
  // Rendering reads no pixel: what training knew of the scene stands in the checkpoint.
  OpenedRun blind = open_run(request.out_dir, {}, all_plugins(), diagnostics, OpenFor::rendering);
  const int frame = opened.session.scene.frames_of(Split::test).front();
  EXPECT_TRUE(blind.session.scene.frames[frame].rgb.empty());
  const RenderedFrame seen = render_frame_of(opened.session, frame), unseen = render_frame_of(blind.session, frame);
  EXPECT_EQ(seen.rgb, unseen.rgb);
  EXPECT_EQ(seen.label, unseen.label);
  EXPECT_EQ(seen.depth_m, unseen.depth_m);
  EXPECT_EQ(seen.entropy, unseen.entropy);
}

// A class that had no label when the run began has some when it goes on: from the file of clicks, or from other labels
// where every class has a logit.
TEST(TrainRun, LabelsOfAnotherClassMayComeWhereEveryClassHasALogit) {
  const TempDir dir;
  const std::string log = dir / "clicks.jsonl";
  const auto train = [&](const std::string& yaml, std::int64_t steps, bool resume) {
    TrainRequest request{.out_dir = dir / "run", .resume = resume};
    RunConfig config = config_of(yaml);
    if (resume) config = load_run_config(request.out_dir + "/run.yaml", {}, all_plugins());
    config.train.steps = steps;
    HookListener hooks;
    EXPECT_EQ(run_training(std::move(config), all_plugins(), request, &hooks).step, steps);
    EXPECT_LACKS(hooks.notes, "the labels are not as they were");
  };
  std::string yaml = replaced(hash_config("report: {eval_every_s: 0}\n"), "analytic_room}",
                              "analytic_room, labels: {frames: none, class_room: 8, clicks: " + log + "}}");
  train(yaml, 4, false);
  EXPECT_LACKS(read_text_file(dir / "run/classes.yaml"), "sofa");
  const Session session = open_text(hash_config());
  const std::string frame = session.scene.info.frames[session.drawn_frames().front()].name;
  const auto click = [&](const std::string& id, const std::string& name) {
    return R"({"id":")" + id + R"(","type":"click","frame":")" + frame +
           R"(","size":[48,36],"points":[[9,9]],"radius":3,"class":")" + name + "\"}\n";
  };
  write_file_atomic(log,
                    "{\"id\":\"1\",\"type\":\"class\",\"name\":\"sofa\"}\n" + click("2", "sofa") + click("3", "wall"));
  train(yaml, 8, true);
  EXPECT_HAS(read_text_file(dir / "run/classes.yaml"), "sofa");
  write_file_atomic(log, read_text_file(log) + R"({"id":"4","type":"rename","class":"sofa","name":"couch"})" + "\n");
  Diagnostics diagnostics;
  const OpenedRun opened = open_run(dir / "run", {}, all_plugins(), diagnostics, OpenFor::evaluation);
  EXPECT_EQ(opened.step, 8);
  EXPECT_EQ(opened.session.plan.class_of_logit.size(), 8u);
  EXPECT_HAS(opened.session.scene.info.classes.to_yaml(), "couch");
}

// The length of a run: stated in steps or in seconds, settled, stored, repeated and gone on with. Clocks are
// counted.

constexpr double kStep_s = 0.25;

/// Every step takes `step_s()` by this clock.
class CountedSteps final : public RunListener {
 public:
  std::function<double(std::int64_t)> step_s = [](std::int64_t) { return kStep_s; };
  std::function<int(std::int64_t)> signal_at = [](std::int64_t) { return 0; };
  std::function<bool(std::int64_t)> save_at = [](std::int64_t) { return false; };
  explicit CountedSteps(bool with_reports = false) : reports(with_reports) {}
  const bool reports;
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

struct RunLengthTest : ::testing::Test {
  RunConfig config(const std::string& more = "") {
    return config_of(hash_config("report: {eval_every_s: 0, checkpoint_every_s: 0}\n" + more), registry_);
  }
  RunConfig stored(const std::string& run) { return load_run_config(dir_ / run + "/run.yaml", {}, registry_); }
  RunConfig asked(const AskedLength& length, const std::string& more = "") {
    RunConfig made = config(more);
    ask(made, length);
    return made;
  }
  TrainOutcome train(RunConfig config, const std::string& run, RunListener&& listener = CountedSteps()) {
    TrainRequest request{.out_dir = dir_ / run};
    return run_training(std::move(config), registry_, request, &listener);
  }
  TrainOutcome train(RunConfig config, const std::string& run, RunListener& listener) {
    return train(std::move(config), run, std::move(listener));
  }
  TrainOutcome resume(const std::string& run, const AskedLength& more, RunListener&& listener = CountedSteps()) {
    TrainRequest request{.out_dir = dir_ / run, .resume = true, .more = more};
    return run_training(stored(run), registry_, request, &listener);
  }
  TrainOutcome resume(const std::string& run, const AskedLength& more, RunListener& listener) {
    return resume(run, more, std::move(listener));
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
  train(stored("timed"), "again");
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
  train(asked({40, 0}), "run");
  copy_as_a_kill_leaves_it("run", "cut");
  CountedSteps more;
  const TrainOutcome ended = resume("run", {30, 0}, more);
  EXPECT_EQ(ended.step, 70);
  EXPECT_NEAR(ended.trained_s, 30 * kStep_s, 1e-9);
  EXPECT_HAS(more.notes, "training continues from step 40, up to 70 steps in all");
  const ScheduleParams schedule = stored("run").schedule;
  EXPECT_NEAR(schedule_factor(schedule, 39), std::pow(0.1, 39.0 / 40), 1e-12);
  EXPECT_EQ(schedule_factor(schedule, 40), 0.5);
  EXPECT_NEAR(schedule_factor(schedule, 70), 0.1, 1e-12);
  // Cut off within the leg, and trained anew by the numbers: the same bits.
  CountedSteps cut;
  cut.signal_at = [](std::int64_t step) { return step == 52 ? 15 : 0; };
  EXPECT_EQ(resume("cut", {30, 0}, cut).step, 52);
  EXPECT_EQ(resume("cut", {}).step, 70);
  EXPECT_EQ(bits("cut", 70), bits("run", 70));
  train(stored("run"), "anew");
  EXPECT_EQ(bits("anew", 70), bits("run", 70));
}

TEST_F(RunLengthTest, AResumeForATimeTrainsThatLongMore) {
  train(asked({40, 0}), "run");
  CountedSteps more;
  more.signal_at = [](std::int64_t step) { return step == 42 ? 2 : 0; };
  EXPECT_EQ(resume("run", {0, 20}, more).step, 42);
  EXPECT_EQ(last_step(stored("run")), 0) << "not settled yet";
  const TrainOutcome ended = resume("run", {});
  EXPECT_EQ(ended.step, 120);
  EXPECT_NEAR(ended.train_s, 40 * kStep_s + 20, 0.01);
  train(stored("run"), "anew");
  EXPECT_EQ(bits("anew", 120), bits("run", 120));
}

TEST_F(RunLengthTest, MoreIsCountedFromTheStepThatIsResumed) {
  CountedSteps clock;
  clock.signal_at = [](std::int64_t step) { return step == 10 ? 2 : 0; };
  train(asked({40, 0}), "run", clock);
  EXPECT_EQ(resume("run", {25, 0}).step, 35) << "in place of what was left";
  const ScheduleParams schedule = stored("run").schedule;
  EXPECT_EQ(schedule_factor(schedule, 10), std::pow(0.1, 10.0 / 40)) << "the rate goes on, for it is above a half";
}

TEST_F(RunLengthTest, ACheckpointOfAnotherSeedIsNotResumed) {
  train(asked({2, 0}), "run");
  const std::string path = dir_ / "run/checkpoints/" + CheckpointStore::file_name(2);
  const TensorFile file = TensorFile::read(path);
  TensorMetadata metadata = file.metadata();
  metadata["seed"] = "9";
  write_safetensors(path, file.tensors(), metadata);
  EXPECT_ERROR(resume("run", {2, 0}), "checkpoint.seed.differs", "its seed is 9, its settings say 1");
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
  const TrainOutcome ended = train(asked({20, 0}), "run", CountedSteps(true));
  const auto before = contents(dir_ / "run");
  CountedSteps nothing(true);
  const TrainOutcome again = resume("run", {}, nothing);
  EXPECT_EQ(contents(dir_ / "run"), before);
  EXPECT_HAS(nothing.notes, "the run has ended at step 20; nothing of it was changed; to train on: ",
             "`semfield train --resume " + (dir_ / "run") + " --time 5s`");
  EXPECT_EQ(again.trained_s, 0);
  EXPECT_EQ(again.step, 20);
  EXPECT_EQ(again.values, ended.values);
  EXPECT_EQ(again.scored.frames, ended.scored.frames);
  EXPECT_EQ(again.report_path, ended.report_path);
  // What it says works.
  EXPECT_EQ(resume("run", {0, 5}, CountedSteps(true)).step, 40);
  // A run whose page or last figures are missing gets them.
  fs::remove(dir_ / "run/final_eval.json");
  fs::remove(dir_ / "run/report.html");
  EXPECT_EQ(resume("run", {}, CountedSteps(true)).step, 40);
  EXPECT_TRUE(fs::exists(dir_ / "run/final_eval.json") && fs::exists(dir_ / "run/report.html"));
}

TEST_F(RunLengthTest, AProgramThatDrivesARunHasTheSameLength) {
  CountedSteps clock;
  TrainRequest options{.out_dir = dir_ / "driven"};
  {
    semfield::Run run(asked({0, 20}), registry_, options, &clock);
    while (!run.training().at_its_end()) run.advance(1000);
    EXPECT_EQ(run.training().step(), 80);
    run.save("");
  }
  train(stored("driven"), "again");
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
}

// What a training run scores, and how the time that evaluation may take bounds it. Clocks are counted, never read.

struct Scored {
  TrainOutcome outcome;
  std::vector<MetricsRow> evals;
  std::vector<std::string> notes;
  std::vector<ScoreProgress> progress;
  std::uint32_t bits = 0;
};

// A run whose every evaluation takes `each_s` by its clock, however many frames it has.
Scored run_scored(const std::string& more, double time_s, double each_s, const TempDir& dir) {
  Registry registry = make_registry();
  RunConfig config = config_of(hash_config(more), registry);
  config.train.steps = 60;
  config.train.time_s = time_s;
  Scored scored;
  HookListener hooks;
  hooks.on_note = [&](const std::string& text) { scored.notes.push_back(text); };
  hooks.on_scoring = [&](const ScoreProgress& p) { scored.progress.push_back(p); };
  double now_s = 0;
  hooks.on_now_s = [&] { return now_s += each_s; };
  TrainRequest request{.out_dir = dir / "run"};
  scored.outcome = run_training(std::move(config), registry, request, &hooks);
  for (const MetricsRow& row : read_metrics(request.out_dir + "/metrics.jsonl")) {
    if (row.kind == "eval") scored.evals.push_back(row);
  }
  scored.bits = checkpoint_fingerprint(request.out_dir, 60);
  return scored;
}

int test_frames() { return static_cast<int>(open_text(hash_config()).scene.frames_of(Split::test).size()); }

TEST(EvalBudget, TheLastEvaluationGetsWhatIsLeftOfTheLimitAndItsShare) {
  EvalBudget budget(0.1, 100);
  budget.spend(2, 1000);  // 2 ms per pixel
  EXPECT_NEAR(budget.left_s(60), 48, 1e-9) << "110 s less 60 s of training and 2 s of evaluation";
  EXPECT_NEAR(budget.left_s(100), 8, 1e-9);
  EXPECT_NEAR(budget.left_s(130), 5, 1e-9) << "a slow step over the limit leaves half of the share";
  EXPECT_EQ(budget.stride_within(48, 24000, 8), 1);
  EXPECT_EQ(budget.stride_within(48, 24001, 8), 2);
  EXPECT_EQ(budget.stride_within(8, 16000, 8), 2) << "32 s; a quarter of the pixels takes 8 s";
  EXPECT_EQ(budget.stride_within(8, 48000e3, 8), 8) << "no smaller than its bound";
}

TEST(EvalBudget, WithoutLimitOrShareNothingIsCut) {
  for (const auto& [share, limit] : {std::pair{0.1, 0.0}, std::pair{0.0, 100.0}}) {
    EvalBudget budget(share, limit);
    budget.spend(1e6, 1);
    EXPECT_EQ(budget.stride_within(budget.left_s(50), 1e9, 8), 1);
  }
}

TEST(EvalBudget, SamplesKeepToHalfOfTheShare) {
  EvalBudget budget(0.1, 0);
  EXPECT_TRUE(budget.has_time_for_sample(0));
  budget.spend(4, 1000);
  EXPECT_FALSE(budget.has_time_for_sample(79)) << "4 s are more than a twentieth";
  EXPECT_TRUE(budget.has_time_for_sample(80));
  EXPECT_EQ(budget.sample_stride(1000, 80, 8), 1);
  EXPECT_EQ(budget.sample_stride(1000, 20, 8), 2);
  EXPECT_EQ(budget.sample_stride(1000, 10, 8), 3) << "a ninth of 4 s is under half a second, a quarter is not";
  EvalBudget free(0, 0);
  free.spend(4, 1000);
  EXPECT_TRUE(free.has_time_for_sample(1));
  EXPECT_EQ(free.sample_stride(1000, 1, 8), 1);
}

// Every frame whatever the time: figures of other frames each time flatter, and turn the order of settings round.
TEST(RunScores, ARunWithATimeLimitScoresEveryFrameAtFewerPixelsAndSaysSo) {
  const int all = test_frames();
  ASSERT_GT(all, 2);
  const TempDir dir, whole_dir;
  // A probe of a frame takes more than a tenth of the time.
  const Scored cut = run_scored("report: {eval_every_s: 0, strips: 2}\n", 1000, 1e5, dir);
  ASSERT_EQ(cut.evals.size(), 1u);
  EXPECT_EQ(cut.evals[0].split, "test_sample");
  EXPECT_EQ(cut.evals[0].get("frames"), all);
  EXPECT_EQ(cut.evals[0].get("split_frames"), all);
  EXPECT_EQ(cut.evals[0].get("pixel_stride"), 2) << "256 of the 48 x 36 pixels of a frame at least";
  EXPECT_EQ(cut.evals[0].get("pixels"), all * 24 * 18);
  const std::string part = "all " + std::to_string(all) + " frames at 1 pixel in 4";
  EXPECT_EQ(cut.outcome.scored.text(), part);
  bool said = false;
  for (const std::string& note : cut.notes)
    said = said || note.find("the last evaluation scores " + part + " to end near the time asked for") == 0;
  EXPECT_TRUE(said) << (cut.notes.empty() ? "" : cut.notes.back());
  const auto detail = nlohmann::json::parse(read_text_file(dir / "run/final_eval.json"));
  EXPECT_EQ(detail["per_frame"].size(), static_cast<std::size_t>(all));
  const Scored whole = run_scored("report: {eval_every_s: 0, strips: 2, eval_share: 0}\n", 1000, 1e5, whole_dir);
  ASSERT_EQ(whole.evals.size(), 1u);
  EXPECT_EQ(whole.evals[0].split, "test");
  EXPECT_EQ(whole.evals[0].get("frames"), all);
  EXPECT_EQ(whole.evals[0].get("pixels"), all * 48 * 36);
  EXPECT_FALSE(whole.evals[0].get("split_frames"));
  EXPECT_EQ(cut.bits, whole.bits) << "what is scored changes no bit of training";
}

// 888 s are left after a probe of 300 s: too little for three frames of 300 s, and half of it is enough for one.
TEST(RunScores, PicturesAreFinerThanTheScoresWhereTheTimeAllowsIt) {
  class Pictures final : public RunListener {
   public:
    std::vector<std::int32_t> width_px;
    double now_s() override { return clock_s_ += 300; }
    std::string write_report(const RunFolder&, const Session&, const ReportFrames& frames) override {
      for (const auto& [score, maps] : frames.strips()) width_px.push_back(maps.width_px);
      return "";
    }

   private:
    double clock_s_ = 0;
  };
  const TempDir dir;
  RunConfig config = config_of(hash_config("report: {eval_every_s: 0, strips: 1, worst_frames: 0}\n"));
  config.train.steps = 60;
  config.train.time_s = 1080;
  Pictures pictures;
  const TrainOutcome outcome = run_training(std::move(config), all_plugins(), {.out_dir = dir / "run"}, &pictures);
  EXPECT_EQ(outcome.scored.stride, 2);
  EXPECT_EQ(pictures.width_px, std::vector<std::int32_t>{48});
}

TEST(RunScores, APartOfTheTrainingFramesIsCalledASample) {
  const TempDir dir;
  const Scored scored = run_scored("report: {eval_every_s: 0, strips: 0, training_frames: 2}\n", 0, 0.001, dir);
  ASSERT_EQ(scored.evals.size(), 2u);
  EXPECT_EQ(scored.evals[1].split, "train_sample");
  EXPECT_EQ(scored.evals[1].get("frames"), 2);
  EXPECT_TRUE(scored.evals[1].get("given_miou"));
  EXPECT_TRUE(scored.evals[1].get("given_right_entropy"));
  EXPECT_FALSE(scored.evals[1].get("given_wrong_entropy")) << "no label is wrong";
  EXPECT_FALSE(scored.evals[0].get("given_right_entropy")) << "test frames train nothing";
  EXPECT_TRUE(scored.evals[0].get("entropy_auroc"));
}

// Figures of training frames against the maps and labels themselves, pixel by pixel, with a stride and without.
TEST(RunScores, EntropyIsGroupedByTheLabelsThatTrained) {
  std::string yaml = with_scene(
      hash_config(), "{type: analytic_room, labels: {frames: 50%, degrade: [{type: pixel_noise, ratio: 0.5}]}}");
  Session s = open_text(yaml);
  EvalJob job = s.eval_job(s.scene.frames_of(Split::train));
  job.frames.resize(4);
  for (const std::int32_t stride : {1, 5}) {
    std::vector<float> right, wrong, none, truly_right, truly_wrong;
    job.stride = stride;
    job.given = &s.labels;
    job.on_frame = [&](const FrameScore& score, const RenderedFrame& maps) {
      const auto f = static_cast<std::size_t>(score.frame);
      const TrainingLabels::Frame& labels = s.labels.frames[f];
      const std::vector<std::int16_t> truth = strided(s.scene.frames[f].label.expand(), 48, 36, 1, stride);
      for (std::size_t i = 0; i < truth.size(); ++i) {
        if (truth[i] == kVoid) continue;
        const PixelPlace at = strided_place(static_cast<std::int64_t>(i), maps.width_px, stride);
        const std::int16_t given = labels.empty() ? kVoid : labels[at.row * 48 + at.column];
        (given == kVoid ? none : given == truth[i] ? right : wrong).push_back(maps.entropy[i]);
        (maps.label[i] == truth[i] ? truly_right : truly_wrong).push_back(maps.entropy[i]);
      }
    };
    const SplitScore score = evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit);
    ASSERT_FALSE(right.empty() || wrong.empty() || none.empty()) << "the case has all three groups";
    std::vector<float> labelled = right;
    labelled.insert(labelled.end(), wrong.begin(), wrong.end());
    const auto mean = [](const std::vector<float>& all) {
      double sum = 0;
      for (const float v : all) sum += static_cast<double>(v);
      return sum / static_cast<double>(all.size());
    };
    const auto every_pair = [](const std::vector<float>& low, const std::vector<float>& high) {
      double won = 0;
      for (const float h : high) {
        for (const float l : low) won += h > l ? 1 : h == l ? 0.5 : 0;
      }
      return won / (static_cast<double>(low.size()) * static_cast<double>(high.size()));
    };
    std::map<std::string, double> values;
    for (const auto& [name, value] : score.values()) {
      if (value) values[name] = *value;
    }
    EXPECT_EQ(values["given_right_px"], static_cast<double>(right.size()));
    EXPECT_EQ(values["given_wrong_px"], static_cast<double>(wrong.size()));
    EXPECT_EQ(values["given_none_px"], static_cast<double>(none.size()));
    EXPECT_NEAR(values["given_right_entropy"], mean(right), 1e-9);
    EXPECT_NEAR(values["given_wrong_entropy"], mean(wrong), 1e-9);
    EXPECT_NEAR(values["given_none_entropy"], mean(none), 1e-9);
    const double bound = score.entropy.detects_wrong()->error;
    EXPECT_NEAR(values["entropy_auroc"], every_pair(truly_right, truly_wrong), bound);
    EXPECT_NEAR(values["given_wrong_auroc"], every_pair(right, wrong), score.given.detects_wrong()->error);
    EXPECT_NEAR(values["given_none_auroc"], every_pair(labelled, none), score.given.detects_none()->error);
  }
  job.given = nullptr;
  job.on_frame = nullptr;
  for (const auto& [name, value] : evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit).values())
    EXPECT_FALSE(name.starts_with("given_")) << name << " without labels to group by";
}

TEST(RunScores, AStrideScoresExactlyThePixelsThatItTakes) {
  Session s = open_text(hash_config());
  EvalJob job = s.eval_job({s.scene.frames_of(Split::test).front()});
  RenderedFrame whole, part;
  job.on_frame = [&](const FrameScore&, const RenderedFrame& maps) { whole = maps; };
  const SplitScore all = evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit);
  job.stride = 5;
  job.on_frame = [&](const FrameScore&, const RenderedFrame& maps) { part = maps; };
  const SplitScore some = evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit);
  EXPECT_EQ(part.width_px, 9);
  EXPECT_EQ(part.height_px, 7);
  EXPECT_EQ(part.rgb, strided(whole.rgb, 48, 36, 3, 5));
  EXPECT_EQ(part.label, strided(whole.label, 48, 36, 1, 5));
  EXPECT_EQ(part.depth_m, strided(whole.depth_m, 48, 36, 1, 5));
  EXPECT_EQ(some.confusion.scored_px(), 63);
  EXPECT_TRUE(some.color.psnr_db());
  EXPECT_TRUE(all.ssim());
  EXPECT_FALSE(some.ssim()) << "it needs neighbours";
}

// Poses that a run has learned, and poses fitted to a field that stays: both come nearer to the true ones.

// Of a camera: three numbers of about the size of a radian, and as many of a metre, that add up to zero over frames.
Pose disturbed(const Pose& pose, int number, double size) {
  float numbers[kPoseNumbers];
  for (int i = 0; i < kPoseNumbers; ++i) numbers[i] = static_cast<float>(size * std::sin(2.3 * number + 1.7 * i + 0.4));
  return corrected(pose, numbers, 1);
}

// Root of the mean square of what two sets of poses differ by, in metres at a point a metre before each camera.
double distance(const std::vector<Pose>& a, const std::vector<Pose>& b) {
  double sum = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    const Vec3d off = a[i].apply({0, 0, 1}) - b[i].apply({0, 0, 1});
    sum += dot(off, off);
  }
  return std::sqrt(sum / static_cast<double>(a.size()));
}

std::vector<Pose> poses_of(const Session& session, Split split) {
  std::vector<Pose> poses;
  for (const int f : session.scene.frames_of(split))
    poses.push_back(session.scene.info.frames[static_cast<std::size_t>(f)].world_from_camera);
  return poses;
}

TEST(RefinedPoses, ComeBackToThoseOfTheField) {
  TestRun run(hash_config());
  run.to(600);
  Session& session = run.session;
  const std::vector<Pose> right = poses_of(session, Split::train);
  const std::vector<int> frames = session.scene.frames_of(Split::train);
  for (std::size_t i = 0; i < frames.size(); ++i) {
    Pose& pose = session.scene.info.frames[static_cast<std::size_t>(frames[i])].world_from_camera;
    pose = disturbed(pose, static_cast<int>(i), 0.03);
  }
  const std::vector<Pose> wrong = poses_of(session, Split::train);
  const std::vector<Pose> refined = refine_poses(session, all_plugins(), frames, {.steps = 200, .rays = 512});
  EXPECT_LT(distance(refined, right), 0.5 * distance(wrong, right));
  EXPECT_EQ(distance(refine_poses(session, all_plugins(), frames, {.steps = 200, .rays = 512}), refined), 0);
}

TEST(LearnedPoses, AreThoseOfTrainingFramesWhenARunIsOpenedAgain) {
  const TempDir dir;
  std::string yaml = replaced(hash_config(), "train: {", "train: {cameras: {poses: learned, pose_rate: 0.1}, ");
  TrainRequest request;
  request.out_dir = dir / "run";
  const ConfigNode tree = parse_config_text(yaml, "test.yaml");
  (void)run_training(run_config_of(tree, all_plugins()), all_plugins(), request, {});
  Diagnostics found;
  const OpenedRun opened = open_run(request.out_dir, {}, all_plugins(), found, OpenFor::rendering);
  EXPECT_HAS(texts(found), "training frames have the poses that the run has learned");
  const Session given = open_text(hash_config());
  EXPECT_GT(distance(poses_of(opened.session, Split::train), poses_of(given, Split::train)), 1e-4);
  EXPECT_EQ(distance(poses_of(opened.session, Split::test), poses_of(given, Split::test)), 0);
}

// A file of another scene, or a damaged one: the given poses stay, and nothing is read past what is there.
TEST(LearnedPoses, OfAnotherShapeAreNotUsed) {
  Session session = open_text(hash_config());
  const std::vector<Pose> given = poses_of(session, Split::train);
  const TempDir dir;
  for (const auto& [rows, cols] : {std::pair{2, 6}, {static_cast<int>(given.size()), 7}}) {
    const std::vector<float> numbers(static_cast<std::size_t>(rows * cols), 0.3F);
    write_safetensors(dir / "state.safetensors",
                      {tensor_ref("cameras/pose/learned", {rows, cols}, std::span<const float>(numbers))}, {});
    Diagnostics found;
    use_learned_poses(session, TensorFile::read(dir / "state.safetensors"), found);
    ASSERT_EQ(found.all().size(), 1U);
    EXPECT_TRUE(found.all().front().code == "run.poses.other");
    EXPECT_EQ(distance(poses_of(session, Split::train), given), 0);
  }
}

}  // namespace
}  // namespace semfield
