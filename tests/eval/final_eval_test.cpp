// final_eval.json and labels.json: made from scores, written, read back, and refused; and pictures of what is rendered.
#include "eval/final_eval.h"

#include <algorithm>
#include <cstring>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

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
    return error_of(ErrorKind::data, [&] { (void)parse_final_eval(json.dump(), "runs/a/final_eval.json"); });
  };
  const auto changed = [&](const char* pointer, const nlohmann::json& value) {
    nlohmann::json json = good;
    json[nlohmann::json::json_pointer(pointer)] = value;
    return refused(json);
  };
  ASSERT_EQ(refused(good), "");
  EXPECT_HAS(refused({}), "runs/a/final_eval.json");
  EXPECT_HAS(changed("/confusion/pixels", {{1}}), "1 rows for 2 classes");
  EXPECT_HAS(changed("/confusion/pixels/0", {1, 2, 3}), "3 entries for 2 classes");
  EXPECT_HAS(changed("/confusion/pixels/0/0", -1), "-1 is not an integer");
  EXPECT_HAS(changed("/confusion/pixels/0/0", 1.5), "1.5 is not an integer");
  EXPECT_HAS(changed("/confusion/pixels/0/0", 18446744073709551615u), "is not an integer");
  EXPECT_HAS(changed("/classes/0/color/1", 256), "256 is not an integer from 0 to 255");
  EXPECT_HAS(changed("/reliability/bins/0/accuracy", 1.5), "outside 0 to 1");
  EXPECT_HAS(changed("/entropy/auroc", -0.5), "outside 0 to 1");
  EXPECT_HAS(changed("/per_frame/0/psnr", "much"), "is not a score");
  EXPECT_THROW((void)parse_final_eval("{", "x"), Error);
}

TEST(LabelCounts, AreSummedFromTheManifestAndComeBack) {
  SceneManifest manifest{
      .classes = 3, .train_class_pixels = {100, 0, 20}, .train_pixels = 1000, .train_frames = 10, .labelled_frames = 2};
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
  EXPECT_HAS(back.rounds[1].text(), "step 45", "350 pixels", "87.5 %", "75.0 %");
  EXPECT_LACKS(json, "self_training");
  EXPECT_THROW((void)parse_rounds("[{\"step\": -1}]", "labels.json"), Error);
}

// Rendered maps: files read back, ids kept, colours even.

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kInf = std::numeric_limits<float>::infinity();

class ImageOutput : public ::testing::Test {
 protected:
  void SetUp() override {
    if (!images_available()) GTEST_SKIP() << "this build cannot read images back (SEMFIELD_WITH_IMAGES=OFF)";
  }
  std::string in(const std::string& name) const { return dir_ / name; }
  const TempDir dir_;
};

// OKLab lightness and coordinates of an sRGB colour [Ottosson20].
std::array<double, 3> oklab(std::array<std::uint8_t, 3> color) {
  double c[3];
  for (std::size_t i = 0; i < 3; ++i) {
    const double v = color[i] / 255.0;
    c[i] = v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
  }
  const double l = std::cbrt(0.4122214708 * c[0] + 0.5363325363 * c[1] + 0.0514459929 * c[2]);
  const double m = std::cbrt(0.2119034982 * c[0] + 0.6806995451 * c[1] + 0.1073969566 * c[2]);
  const double s = std::cbrt(0.0883024619 * c[0] + 0.2817188376 * c[1] + 0.6299787005 * c[2]);
  return {0.2104542553 * l + 0.7936177850 * m - 0.0040720468 * s,
          1.9779984951 * l - 2.4285922050 * m + 0.4505937099 * s,
          0.0259040371 * l + 0.7827717662 * m - 0.8086757660 * s};
}

TEST(PerceptualMap, LightnessRisesEvenlyAndStepsLookEqual) {
  double smallest = 1e9, largest = 0;
  for (int i = 0; i < 32; ++i) {
    const auto a = oklab(perceptual_color(i / 32.0));
    const auto b = oklab(perceptual_color((i + 1) / 32.0));
    EXPECT_NEAR(a[0], 0.22 + 0.73 * i / 32, 0.01) << i;
    EXPECT_GT(b[0], a[0]);
    const double step = std::hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    smallest = std::min(smallest, step);
    largest = std::max(largest, step);
  }
  EXPECT_LT(largest / smallest, 1.35);
  EXPECT_EQ(perceptual_color(-1), perceptual_color(0));
  EXPECT_EQ(perceptual_color(kInf), perceptual_color(1));
  EXPECT_EQ(perceptual_color(kNan), (std::array<std::uint8_t, 3>{0, 0, 0}));
}

ClassTable classes(std::int32_t last_id) {
  return ClassTable(
      {{0, "void", {9, 8, 7}, true}, {3, "wall", {10, 20, 30}, false}, {last_id, "lamp", {200, 100, 50}, false}});
}

TEST_F(ImageOutput, LabelsCarryOriginalIds) {
  const std::vector<std::int16_t> label{0, 1, kVoid, 1};
  for (std::int32_t last : {40, 1000}) {
    write_label_ids(in("label.png"), {2, 2}, label, classes(last));
    write_label_colors(in("vis.png"), {2, 2}, label, classes(last));
    const Image<std::uint16_t> ids = read_ids(in("label.png"));
    const auto id = static_cast<std::uint16_t>(last);
    EXPECT_EQ(ids.pixels, (std::vector<std::uint16_t>{3, id, 0, id}));
    EXPECT_EQ(image_size(in("label.png")).bits, last > 254 ? 16 : 8);
    EXPECT_EQ(read_rgb(in("vis.png")).pixels,
              (std::vector<std::uint8_t>{10, 20, 30, 200, 100, 50, 9, 8, 7, 200, 100, 50}));
  }
  write_label_colors(in("palette.png"), {2, 2}, label, classes(40));
  EXPECT_EQ(read_ids(in("palette.png")).pixels, (std::vector<std::uint16_t>{3, 40, 0, 40}));
  EXPECT_THROW(write_label_ids(in("bad.png"), {2, 1}, std::vector<std::int16_t>{0, 2}, classes(40)), Error);
  EXPECT_THROW(write_label_ids(in("bad.png"), {2, 1}, std::vector<std::int16_t>{0, 1}, classes(70000)), Error);
  EXPECT_FALSE(fs::exists(in("bad.png")));
}

TEST_F(ImageOutput, DepthInSteps) {
  const std::vector<float> depth{1.2345f, 0, kNan, 65.534f, 65.535f, -1, kInf, 0.0004f};
  EXPECT_EQ(write_depth(in("d.png"), {4, 2}, depth, 0.001), 2) << "readers take 65535 for none";
  EXPECT_EQ(read_ids(in("d.png")).pixels, (std::vector<std::uint16_t>{1235, 0, 0, 65534, 0, 0, 0, 0}));
  EXPECT_EQ(write_depth(in("d.png"), {4, 2}, depth, 0.01), 1);
  EXPECT_EQ(read_ids(in("d.png")).pixels, (std::vector<std::uint16_t>{123, 0, 0, 6553, 6554, 0, 0, 0}));
}

TEST_F(ImageOutput, EntropyUsesTheFullRange) {
  const float most = static_cast<float>(std::log(8.0));
  write_entropy(in("e.png"), {4, 1}, std::vector<float>{0, most, most / 2, -1e-9f}, 8);
  const auto values = read_ids(in("e.png")).pixels;
  EXPECT_EQ(values[0], 0);
  EXPECT_EQ(values[1], 65535);
  EXPECT_NEAR(values[2], 32768, 1);
  EXPECT_EQ(values[3], 0);
  write_entropy(in("one.png"), {1, 1}, std::vector<float>{0}, 1);
  EXPECT_EQ(read_ids(in("one.png")).pixels[0], 0);
}

TEST_F(ImageOutput, ColoursRoundAndNanIsNamed) {
  write_color(in("c.png"), {2, 1}, std::vector<float>{0, 0.5f, 1, -1, 2, 0.2f});
  EXPECT_EQ(read_rgb(in("c.png")).pixels, (std::vector<std::uint8_t>{0, 128, 255, 0, 255, 51}));
  EXPECT_HAS(error_of([&] { (void)to_bytes(std::vector<float>{0, 0, 0, 0, kNan, 0}); }), "pixel 1, channel 1");
}

TEST_F(ImageOutput, NpyHoldsTheFloats) {
  write_map_npy(in("m.npy"), {3, 2}, std::vector<float>{1, 2, 3, 4, 5, 6});
  const std::string file = read_text_file(in("m.npy"));
  EXPECT_EQ(file.substr(1, 5), "NUMPY");
  EXPECT_HAS(file, "'shape': (2, 3)");
  float last = 0;
  std::memcpy(&last, file.data() + file.size() - 4, 4);
  EXPECT_EQ(last, 6.0f);
}

TEST(DepthColors, NearIsBrightAndInvalidIsBlack) {
  const std::vector<float> depth{1, 5, 0, kNan};
  const auto rgb = depth_colors(depth, 1, 5);
  EXPECT_GT(rgb[0] + rgb[1] + rgb[2], rgb[3] + rgb[4] + rgb[5]);
  for (std::size_t i = 6; i < 12; ++i) EXPECT_EQ(rgb[i], 0);
  std::vector<float> many;
  for (int i = 100; i >= 0; --i) many.push_back(static_cast<float>(i));
  const DepthRange range = robust_depth_range(many);
  EXPECT_EQ(range.near_m, 2);  // rank floor(0.02 * 99) of 1..100
  EXPECT_EQ(range.far_m, 98);
  EXPECT_EQ(robust_depth_range(std::vector<float>{0, kNan}).far_m, 1);
}

}  // namespace
}  // namespace semfield
