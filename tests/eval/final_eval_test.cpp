// final_eval.json and labels.json: made from scores, written, read back, and refused when they are not what they claim.
#include "eval/final_eval.h"

#include <gtest/gtest.h>

#include <limits>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "tests/says.h"

namespace semfield {
namespace {

const ClassTable kTable({{0, "void", {0, 0, 0}, true},
                         {3, "wall \"a\"", {1, 2, 3}, false},
                         {7, "never", {4, 5, 6}, false},
                         {9, "chair", {7, 8, 9}, false}});

// Two frames of truth wall, wall, chair, void; one chair is taken for a wall with confidence 0.9.
SplitScore sample_score() {
  SplitScore score(kTable.valid_count(), 10);
  const std::vector<std::int16_t> truth{0, 0, 2, 2, kVoid}, predicted{0, 0, 2, 0, 0};
  score.confusion.add(truth, predicted);
  const std::vector<float> confidence{0.5F, 0.52F, 1.0F, 0.9F, 0.3F}, of_truth{0.5F, 0.52F, 1.0F, 0.05F, 0.3F};
  score.calibration.add(confidence, of_truth, predicted, truth);
  score.entropy.add(std::vector<float>{0.7F, 0.6F, 0.01F, 0.65F, 1.0F}, predicted, truth);
  FrameScore a, b;
  a.name = "left/1";
  a.psnr_db = std::numeric_limits<double>::infinity();
  a.miou_present = 0.25;
  b.name = "2";
  b.psnr_db = 20.5;
  b.absrel = 0.125;
  score.frames = {a, b};
  return score;
}

FinalEval sample_eval() {
  FinalEval eval = final_eval(sample_score(), kTable, "test");
  eval.step = 400;
  eval.train_s = 12.5;
  return eval;
}

TEST(FinalEval, KeepsPresentClassesAndBinsByHand) {
  const FinalEval eval = sample_eval();
  ASSERT_EQ(eval.classes.size(), 2u) << "a class that occurs nowhere is not kept";
  EXPECT_EQ(eval.classes[0].id, 3);
  EXPECT_EQ(eval.classes[1].name, "chair");
  EXPECT_EQ(eval.classes[1].color, (std::array<std::uint8_t, 3>{7, 8, 9}));
  EXPECT_EQ(eval.confusion, (std::vector<std::int64_t>{2, 0, 1, 1}));
  EXPECT_EQ(eval.count(1, 0), 1) << "row: truth, column: prediction";
  EXPECT_EQ(eval.void_truth_px, 1);
  // 15 bins of width 1/15: 0.5 and 0.52 in (7/15, 8/15], 0.9 in (13/15, 14/15], 1 in the last.
  ASSERT_EQ(eval.bins.size(), 15u);
  EXPECT_EQ(eval.bins[7].pixels, 2);
  EXPECT_NEAR(eval.bins[7].confidence, 0.51, 1e-7);
  EXPECT_EQ(eval.bins[7].accuracy, 1);
  EXPECT_EQ(eval.bins[13].pixels, 1);
  EXPECT_EQ(eval.bins[13].accuracy, 0);
  EXPECT_EQ(eval.bins[14].pixels, 1);
  EXPECT_EQ(eval.bins[0].pixels, 0);
  EXPECT_NEAR(*eval.ece(), (2 * 0.49 + 0.9 + 0) / 4, 1e-6);
  EXPECT_NEAR(*eval.ece(), *sample_score().calibration.ece(), 1e-12) << "the bins carry the figure of metrics.jsonl";
  ASSERT_TRUE(eval.entropy_auroc);
  EXPECT_NEAR(eval.entropy_auroc->value, 2.0 / 3, 1e-15) << "0.65 of the wrong chair against 0.7, 0.6 and 0.01";
}

TEST(FinalEval, ComesBackAsWritten) {
  const FinalEval eval = sample_eval();
  const std::string json = final_eval_json(eval);
  const FinalEval back = parse_final_eval(json, "final_eval.json");
  EXPECT_EQ(final_eval_json(back), json);
  EXPECT_EQ(back.step, 400);
  EXPECT_EQ(back.confusion, eval.confusion);
  EXPECT_EQ(back.frames[0].name, "left/1");
  EXPECT_EQ(back.frames[0].psnr_db, std::numeric_limits<double>::infinity());
  EXPECT_FALSE(back.frames[0].absrel.has_value());
  EXPECT_EQ(*back.ece(), *eval.ece());
  EXPECT_EQ(back.entropy_auroc->value, eval.entropy_auroc->value);
  const nlohmann::json read = nlohmann::json::parse(json);
  EXPECT_EQ(read["confusion"]["pixels"][1][0], 1);
  EXPECT_TRUE(read["reliability"]["bins"][0]["accuracy"].is_null()) << "a bin without pixels has no accuracy";
  EXPECT_NEAR(read["entropy"]["auroc"].get<double>(), 2.0 / 3, 1e-15);
  EXPECT_EQ(read["entropy"]["auroc_error"], 0);
  nlohmann::json earlier = read;
  earlier.erase("entropy");
  EXPECT_FALSE(parse_final_eval(earlier.dump(), "x").entropy_auroc) << "of a version that did not count it";
}

TEST(FinalEval, WithoutLabelsThereIsNoMatrixAndNoBin) {
  SplitScore score(0, 10);
  const FinalEval eval = parse_final_eval(final_eval_json(final_eval(score, {}, "test")), "x");
  EXPECT_TRUE(eval.classes.empty());
  EXPECT_TRUE(eval.bins.empty());
  EXPECT_FALSE(eval.ece().has_value());
  EXPECT_FALSE(eval.entropy_auroc);
  // A pixel without finite probabilities takes the figure away, as in metrics.jsonl.
  FinalEval broken = sample_eval();
  broken.nonfinite_px = 1;
  EXPECT_FALSE(broken.ece().has_value());
}

TEST(FinalEval, RefusesWhatItDidNotWrite) {
  const nlohmann::json good = nlohmann::json::parse(final_eval_json(sample_eval()));
  const auto refused = [](const nlohmann::json& json) {
    try {
      (void)parse_final_eval(json.dump(), "runs/a/final_eval.json");
    } catch (const Error& e) {
      EXPECT_EQ(e.kind(), ErrorKind::data);
      return std::string(e.what());
    }
    return std::string("accepted");
  };
  const auto changed = [&](const char* pointer, const nlohmann::json& value) {
    nlohmann::json json = good;
    json[nlohmann::json::json_pointer(pointer)] = value;
    return refused(json);
  };
  ASSERT_EQ(refused(good), "accepted");
  EXPECT_NE(refused({}).find("runs/a/final_eval.json"), std::string::npos);
  EXPECT_NE(changed("/confusion/pixels", {{1}}).find("1 rows for 2 classes"), std::string::npos);
  EXPECT_NE(changed("/confusion/pixels/0", {1, 2, 3}).find("3 entries for 2 classes"), std::string::npos);
  EXPECT_NE(changed("/confusion/pixels/0/0", -1).find("-1 is no integer"), std::string::npos);
  EXPECT_NE(changed("/confusion/pixels/0/0", 1.5).find("1.5 is no integer"), std::string::npos);
  EXPECT_NE(changed("/confusion/pixels/0/0", 18446744073709551615u).find("is no integer"), std::string::npos);
  EXPECT_NE(changed("/classes/0/color/1", 256).find("256 is no integer from 0 to 255"), std::string::npos);
  EXPECT_NE(changed("/reliability/bins/0/accuracy", 1.5).find("outside 0 to 1"), std::string::npos);
  EXPECT_NE(changed("/entropy/auroc", -0.5).find("outside 0 to 1"), std::string::npos);
  EXPECT_NE(changed("/per_frame/0/psnr", "much").find("is no score"), std::string::npos);
  EXPECT_THROW((void)parse_final_eval("{", "x"), Error);
}

TEST(LabelCounts, AreSummedFromTheManifestAndComeBack) {
  SceneManifest manifest;
  manifest.classes = 3;
  manifest.train_class_pixels = {100, 0, 20};
  manifest.train_pixels = 1000;
  manifest.train_frames = 10;
  manifest.labelled_frames = 2;
  const LabelCounts counts =
      label_counts(manifest, kTable, {{"pixel_noise", {{"pixels changed", "12"}, {"seed", "3"}}}});
  EXPECT_EQ(counts.labelled_px, 120);
  ASSERT_EQ(counts.classes.size(), 3u);
  EXPECT_EQ(counts.classes[2].id, 9);
  const std::string json = label_counts_json(counts);
  EXPECT_EQ(label_counts_json(parse_label_counts(json, "labels.json")), json);
  EXPECT_EQ(parse_label_counts(json, "labels.json").labelled_frames, 2);
  ASSERT_EQ(parse_label_counts(json, "labels.json").steps.size(), 1u);
  EXPECT_EQ(parse_label_counts(json, "labels.json").steps[0].facts, counts.steps[0].facts);
  EXPECT_THROW((void)parse_label_counts("{\"train_frames\": -1}", "labels.json"), Error);
  EXPECT_THROW((void)parse_label_counts("[]", "labels.json"), Error);
  LabelCounts with_rounds = counts;
  with_rounds.rounds = {{30, 400, 300, 0, 0}, {45, 400, 350, 200, 150}};
  const LabelCounts back = parse_label_counts(label_counts_json(with_rounds), "labels.json");
  EXPECT_EQ(back.rounds, with_rounds.rounds);
  EXPECT_FALSE(back.rounds[0].accuracy());
  EXPECT_EQ(unsaid(back.rounds[1].text(), {"step 45", "350 pixels", "87.5 %", "75.0 %"}), "");
  EXPECT_EQ(json.find("self_training"), std::string::npos);
  EXPECT_THROW((void)parse_rounds("[{\"step\": -1}]", "labels.json"), Error);
}

}  // namespace
}  // namespace semfield
