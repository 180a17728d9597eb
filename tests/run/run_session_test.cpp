// A run driven step by step: the bits and the folder of the whole run, saved here and there, gone on with.
#include "run/run_session.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <string>
#include <vector>

#include "eval/final_eval.h"
#include "run/train_run.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
namespace fs = std::filesystem;

constexpr int kSteps = 20;

class RunSessionTest : public ::testing::Test {
 protected:
  RunSessionTest() { write_packed_config(dir_, kSteps, 0); }
  RunConfig config(const std::vector<std::string>& set = {}) {
    return load_run_config(dir_ / "config.yaml", set, registry_);
  }
  static void drive(RunSession& run, std::int64_t until) {
    while (run.training().step() < until) run.advance(until - run.training().step());
  }
  std::uint32_t whole_run(const std::vector<std::string>& set = {}) {
    TrainRequest request;
    request.out_dir = dir_ / "whole";
    run_training(config(set), registry_, request);
    return checkpoint_fingerprint(request.out_dir, kSteps);
  }
  std::string refusal(const std::function<void()>& call) {
    try {
      call();
    } catch (const Error& error) {
      return error.what();
    }
    return "nothing was refused";
  }

  TempDir dir_;
  Registry registry_ = make_registry();
  struct Listener final : RunListener {
    int stop_signal() override { return stops ? 15 : 0; }
    void row(const MetricsRow&) override { ++rows; }
    bool stops = false;
    int rows = 0;
  } nobody_;
};

TEST_F(RunSessionTest, HasTheBitsAndTheRowsOfTheWholeRun) {
  const std::uint32_t bits = whole_run();
  RunSession run(config(), registry_, {}, nobody_);
  drive(run, 7);
  drive(run, kSteps);
  EXPECT_EQ(run.run_dir(), "");
  run.save(dir_ / "driven");
  EXPECT_EQ(checkpoint_fingerprint(dir_ / "driven", kSteps), bits);
  std::vector<MetricsRow> theirs = read_metrics(dir_ / "whole/metrics.jsonl");
  std::erase_if(theirs, [](const MetricsRow& row) { return row.kind != "train"; });
  const std::vector<MetricsRow> mine = read_metrics(dir_ / "driven/metrics.jsonl");
  ASSERT_EQ(mine.size(), theirs.size());
  EXPECT_EQ(std::ssize(mine), nobody_.rows);
  for (std::size_t i = 0; i < mine.size(); ++i) {
    EXPECT_EQ(mine[i].step, theirs[i].step);
    EXPECT_EQ(mine[i].get("loss"), theirs[i].get("loss"));
    EXPECT_EQ(mine[i].get("psnr"), theirs[i].get("psnr"));
  }
  // A verb goes on with it where it is.
  TrainRequest request;
  request.out_dir = dir_ / "driven";
  request.resume = true;
  EXPECT_EQ(
      run_training(load_run_config(dir_ / "driven/run.yaml", {"train.steps=25"}, registry_), registry_, request).step,
      25);
  EXPECT_NE(refusal([&] { run.save(""); }).find("somebody went on with the run"), std::string::npos);
}

TEST_F(RunSessionTest, GoesOnFromWhereItWasSaved) {
  const std::uint32_t bits = whole_run();
  {
    RunSession run(config(), registry_, {dir_ / "a", false, {}}, nobody_);
    drive(run, 12);
    run.save("");
    EXPECT_NE(refusal([&] { run.save(dir_ / "b"); }).find("cannot be saved in"), std::string::npos);
    EXPECT_FALSE(fs::exists(dir_ / "b"));
  }
  RunSession again(load_run_config(dir_ / "a/run.yaml", {}, registry_), registry_, {dir_ / "a", true, {}}, nobody_);
  EXPECT_EQ(again.training().step(), 12);
  drive(again, kSteps);
  again.save("");
  EXPECT_EQ(checkpoint_fingerprint(dir_ / "a", kSteps), bits);
}

TEST_F(RunSessionTest, RoundsOfSelfTrainingNeedAFolderAndHaveTheBitsOfTheWholeRun) {
  const std::vector<std::string> set{"scene.labels.degrade=[{type: propagation}]", "train.self_training.at=[0.5]",
                                     "train.self_training.confidence=0.3", "train.ray_source=label_balanced"};
  EXPECT_NE(refusal([&] { RunSession(config(set), registry_, {}, nobody_); }).find("train.self_training"),
            std::string::npos);
  const std::uint32_t bits = whole_run(set);
  RunSession run(config(set), registry_, {dir_ / "driven", false, {}}, nobody_);
  drive(run, 3);
  // A stop before the round leaves it due.
  while (run.training().step() < 10) run.advance(10 - run.training().step());
  nobody_.stops = true;
  EXPECT_TRUE(run.advance(5).empty());
  nobody_.stops = false;
  EXPECT_EQ(run.training().step(), 10);
  drive(run, kSteps);
  run.save("");
  EXPECT_EQ(checkpoint_fingerprint(dir_ / "driven", kSteps), bits);
  EXPECT_EQ(parse_label_counts(read_text_file(dir_ / "driven/labels.json"), "labels.json").rounds.size(), 1U);
}

// What may happen between steps is the driver's to say: who waits for a disk writes rows and checkpoints when asked.
TEST_F(RunSessionTest, ADriverSaysWhatHappensBetweenSteps) {
  const auto advanced = [&](const std::string& folder, const RunLoopOptions& options) {
    TrainRequest request;
    request.out_dir = dir_ / folder;
    RunLoop run(open_for_training(config({"report.checkpoint_every_s=1e-9", "report.eval_every_s=1e-9"}), registry_,
                                  request, nobody_),
                registry_, &nobody_, options);
    while (run.training().step() < kSteps) run.advance(kSteps);
    EXPECT_EQ(run.saved(), options.saves);
    const std::vector<MetricsRow> before = read_metrics(dir_ / folder + "/metrics.jsonl");
    run.save();
    return std::pair(before, read_metrics(dir_ / folder + "/metrics.jsonl"));
  };
  const auto is_eval = [](const MetricsRow& row) { return row.kind == "eval"; };
  const auto [waiting, saved] = advanced("waits", {.rounds = false, .rows_wait = true});
  EXPECT_TRUE(waiting.empty());
  EXPECT_FALSE(saved.empty());
  EXPECT_FALSE(fs::exists(dir_ / "waits/labels.json"));
  EXPECT_EQ(std::ranges::count_if(saved, is_eval), 0);
  const auto [scored, ended] = advanced("scores", {.scores = true, .saves = true});
  EXPECT_EQ(ended.size(), scored.size());
  EXPECT_GT(std::ranges::count_if(scored, is_eval), 0);
  EXPECT_EQ(checkpoint_fingerprint(dir_ / "scores", kSteps), checkpoint_fingerprint(dir_ / "waits", kSteps));
  EXPECT_EQ(std::ssize(scored) - std::ranges::count_if(scored, is_eval), std::ssize(saved));
}

TEST_F(RunSessionTest, ClicksAreInTheFolderBeforeTheyCount) {
  LabelEvent click;
  click.id = "c1";
  click.class_name = "lamp";
  click.points = {{5.5, 5.5}};
  LabelEvent lamp;
  lamp.id = "c0";
  lamp.kind = LabelEventKind::add_class;
  lamp.class_name = "lamp";
  RunSession bare(config(), registry_, {}, nobody_);
  EXPECT_NE(refusal([&] { bare.apply(lamp); }).find("no file of clicks"), std::string::npos);
  const std::vector<std::string> room{"scene.labels.class_room=12"};
  std::uint32_t bits = 0;
  {
    RunSession run(config(room), registry_, {dir_ / "a", false, {}}, nobody_);
    drive(run, 4);
    const FrameInfo& frame =
        run.session().scene.info.frames[static_cast<std::size_t>(run.session().drawn_frames().front())];
    click.frame = frame.name;
    click.width_px = frame.camera.width_px;
    click.height_px = frame.camera.height_px;
    EXPECT_TRUE(run.apply(lamp));
    EXPECT_TRUE(run.apply(click));
    EXPECT_FALSE(run.apply(click));
    EXPECT_EQ(std::ranges::count(read_text_file(dir_ / "a/clicks.jsonl"), '\n'), 2);
    EXPECT_NE(read_text_file(dir_ / "a/classes.yaml").find("lamp"), std::string::npos);
    LabelEvent wrong = click;
    wrong.id = "c2";
    wrong.class_name = "lampe";
    EXPECT_NE(refusal([&] { run.apply(wrong); }), "nothing was refused");
    EXPECT_EQ(run.annotations()->marks().size(), 1U);
    EXPECT_EQ(std::ranges::count(read_text_file(dir_ / "a/clicks.jsonl"), '\n'), 2);
    drive(run, 8);
    run.save("");
    drive(run, 12);
    bits = fingerprint(run.session().pipeline->store());
  }
  RunSession again(load_run_config(dir_ / "a/run.yaml", {}, registry_), registry_, {dir_ / "a", true, {}}, nobody_);
  EXPECT_EQ(again.annotations()->marks().size(), 1U);
  drive(again, 12);
  EXPECT_EQ(fingerprint(again.session().pipeline->store()), bits);
}

}  // namespace
}  // namespace semfield
