// What a training run scores, and how the time that evaluation may take bounds it. Clocks are counted, never read.
#include "run/run_scores.h"

#include "eval/evaluator.h"
#include "eval/final_eval.h"
#include "run/run_loop.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

RunConfig config_of(const std::string& yaml, Registry& registry) {
  Diagnostics diagnostics;
  RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  return config;
}

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
  EXPECT_EQ(parse_final_eval(read_text_file(dir / "run/final_eval.json"), "f").frames.size(),
            static_cast<std::size_t>(all));
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
  Registry registry = make_registry();
  RunConfig config = config_of(hash_config("report: {eval_every_s: 0, strips: 1, worst_frames: 0}\n"), registry);
  config.train.steps = 60;
  config.train.time_s = 1080;
  Pictures pictures;
  const TrainOutcome outcome = run_training(std::move(config), registry, {.out_dir = dir / "run"}, &pictures);
  EXPECT_EQ(outcome.scored.stride, 2);
  EXPECT_EQ(pictures.width_px, std::vector<std::int32_t>{48});
}

TEST(RunScores, WithoutATimeLimitTheWholeSplitIsScored) {
  const TempDir dir;
  const Scored scored = run_scored("report: {eval_every_s: 0, strips: 0}\n", 0, 1e6, dir);
  ASSERT_EQ(scored.evals.size(), 1u);
  EXPECT_EQ(scored.evals[0].split, "test");
  EXPECT_TRUE(scored.outcome.scored.whole());
  EXPECT_FALSE(scored.evals[0].per_class_iou.empty());
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

}  // namespace
}  // namespace semfield
