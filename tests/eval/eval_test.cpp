// Metrics against values computed by hand, and the rules of merging. Cases H01 to H05 of tests/numerics have depth, and
// what is absent or bad.

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>
#include <random>

#include "eval/evaluator.h"
#include "eval/final_eval.h"
#include "eval/image_output.h"
#include "eval/metrics.h"
#include "formats/image_io.h"
#include "tests/says.h"
#include "tests/temp_dir.h"
#include "tests/threads.h"

namespace semfield {
namespace {

using Labels = std::vector<std::int16_t>;
using Floats = std::vector<float>;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

TEST(Psnr, IsOfThePooledErrorNotTheMeanOverImages) {
  ColorError first, second;
  first.add(Floats{0, 0, 0}, Floats{0.5f, 0.5f, 0.5f});  // squared error 0.25 each
  second.add(Floats{1}, Floats{1});
  first.merge(second);
  EXPECT_DOUBLE_EQ(*first.mse(), 0.1875);
  EXPECT_NEAR(*first.psnr_db(), 7.269987279, 1e-9);
}

TEST(Confusion, MergeEqualsOneAdd) {
  const Labels truth{0, 1, 1, 0, -1, 1}, predicted{0, 1, 0, 1, 0, 1};
  ConfusionMatrix whole(2), first(2), second(2);
  whole.add(truth, predicted);
  first.add(std::span(truth).first(2), std::span(predicted).first(2));
  second.add(std::span(truth).subspan(2), std::span(predicted).subspan(2));
  first.merge(second);
  for (int t = 0; t < 2; ++t) {
    for (int p = 0; p < 2; ++p) EXPECT_EQ(whole.count(t, p), first.count(t, p));
  }
}

TEST(Ssim, KnownValues) {
  constexpr int kSize = 16;
  Floats a(kSize * kSize), black(a.size(), 0.0f), white(a.size(), 1.0f);
  for (std::size_t i = 0; i < a.size(); ++i) a[i] = static_cast<float>((i * 7919) % 101) / 100.0f;
  EXPECT_DOUBLE_EQ(*ssim(a, a, kSize, kSize, 1), 1.0);
  // Constant images: only the luminance term, C1 / (1 + C1).
  EXPECT_NEAR(*ssim(black, white, kSize, kSize, 1), 1e-4 / (1 + 1e-4), 1e-12);
  EXPECT_FALSE(ssim(Floats(100), Floats(100), 10, 10, 1));
}

TEST(Ssim, WindowsThatHoldAMaskedPixelDoNotCount) {
  constexpr int kWide = 30, kHigh = 20;
  Floats a(kWide * kHigh), b(a.size());
  for (std::size_t i = 0; i < a.size(); ++i) a[i] = b[i] = static_cast<float>((i * 7919) % 101) / 100.0f;
  std::vector<std::uint8_t> used(a.size(), 1);
  for (std::size_t y = 0; y < kHigh; ++y) {  // a column that is wrong, and masked
    b[y * kWide + 15] = 0;
    used[y * kWide + 15] = 0;
  }
  EXPECT_LT(*ssim(a, b, kWide, kHigh, 1), 0.99);
  EXPECT_DOUBLE_EQ(*ssim(a, b, kWide, kHigh, 1, used), 1.0);
  used.assign(a.size(), 1);
  used[7 * kWide + 15] = 0;  // one of its pixels alone
  EXPECT_LT(*ssim(a, b, kWide, kHigh, 1, used), 1.0);
  used.assign(a.size(), 0);
  EXPECT_FALSE(ssim(a, b, kWide, kHigh, 1, used)) << "nothing counts";
}

// The same definition written directly: two-dimensional weights, two passes.
double plain_ssim(const Floats& x, const Floats& y, int width, int height, int channels) {
  double total = 0;
  int windows = 0;
  for (int c = 0; c < channels; ++c) {
    for (int v = 5; v < height - 5; ++v) {
      for (int u = 5; u < width - 5; ++u, ++windows) {
        const auto sum = [&](auto&& value) {
          double weights = 0, s = 0;
          for (int j = -5; j <= 5; ++j) {
            for (int i = -5; i <= 5; ++i) {
              const double w = std::exp(-(i * i + j * j) / (2 * 1.5 * 1.5));
              weights += w;
              s += w * value(static_cast<std::size_t>(((v + j) * width + u + i) * channels + c));
            }
          }
          return s / weights;
        };
        const double mx = sum([&](std::size_t i) { return double(x[i]); });
        const double my = sum([&](std::size_t i) { return double(y[i]); });
        const double vx = sum([&](std::size_t i) { return (x[i] - mx) * (x[i] - mx); });
        const double vy = sum([&](std::size_t i) { return (y[i] - my) * (y[i] - my); });
        const double vxy = sum([&](std::size_t i) { return (x[i] - mx) * (y[i] - my); });
        total += (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4));
      }
    }
  }
  return total / windows;
}

TEST(Ssim, AgreesWithThePlainDefinitionOnAnyThreadCount) {
  constexpr int kWidth = 19, kHeight = 14;
  Floats x(kWidth * kHeight * 3), y(x.size());
  for (std::size_t i = 0; i < x.size(); ++i) {
    x[i] = static_cast<float>((i * 7919) % 101) / 100.0f;
    y[i] = 0.7f * x[i] + static_cast<float>((i * 104729) % 31) / 100.0f;
  }
  const auto made = [&] { return *ssim(x, y, kWidth, kHeight, 3); };
  const double one = on_threads(1, made), three = on_threads(3, made);
  EXPECT_NEAR(one, plain_ssim(x, y, kWidth, kHeight, 3), 1e-12);
  EXPECT_EQ(one, three);
}

TEST(Calibration, ByHand) {
  Calibration c;
  // Confidences 0.9 (right), 0.9 (wrong), 0.6 (right); one void pixel.
  c.add(Floats{0.9f, 0.9f, 0.6f, 1}, Floats{0.9f, 0.1f, 0.6f, 0}, Labels{0, 0, 1, 0}, Labels{0, 1, 1, -1});
  EXPECT_EQ(c.scored_px(), 3);
  EXPECT_NEAR(*c.ece(), (std::abs(1 - 1.8) + std::abs(1 - 0.6)) / 3, 1e-7);
  EXPECT_NEAR(*c.nll(), -(std::log(0.9) + std::log(0.1) + std::log(0.6)) / 3, 1e-7);
}

TEST(Calibration, ZeroProbabilityStaysFinite) {
  Calibration c;
  c.add(Floats{1}, Floats{0}, Labels{0}, Labels{1});
  EXPECT_NEAR(*c.nll(), -std::log(1.17549435e-38), 1e-6);
  EXPECT_DOUBLE_EQ(*c.ece(), 1.0);
}

TEST(Entropy, OneHotIsExactlyZeroAndUniformIsLnC) {
  EXPECT_EQ(entropy_nats(Floats{0, 1, 0}), 0.0);
  EXPECT_NEAR(entropy_nats(Floats{0.25f, 0.25f, 0.25f, 0.25f}), std::log(4.0), 1e-12);
}

// Entropy of groups of pixels against every pair compared by itself.

constexpr std::int16_t kV = -1;  // void

// Mann-Whitney: pairs in which the second has more, ties one half.
double every_pair(const Floats& low, const Floats& high) {
  double won = 0;
  for (const float h : high) {
    for (const float l : low) won += h > l ? 1 : h == l ? 0.5 : 0;
  }
  return won / (static_cast<double>(low.size()) * static_cast<double>(high.size()));
}

EntropyHistogram histogram(const Floats& values) {
  EntropyHistogram out;
  for (const float v : values) out.add(v);
  return out;
}

// Entropies of 24 classes as a field gives them: many orders of magnitude, most near 0, some exactly there.
Floats entropies(std::size_t count, double centre, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> decades(centre, 2);
  Floats out(count);
  for (float& v : out) v = static_cast<float>(std::min(std::log(24.0), std::exp(decades(random)) - 1e-7));
  return out;
}

TEST(EntropyAuroc, AgreesWithEveryPairWithinItsBound) {
  for (const auto& [low_at, high_at] : {std::pair{-6.0, -1.0}, {-3.0, -3.0}, {-1.0, -6.0}, {-14.0, -12.0}}) {
    const Floats low = entropies(3000, low_at, 1), high = entropies(700, high_at, 2);
    const std::optional<Auroc> found = auroc(histogram(low), histogram(high));
    ASSERT_TRUE(found);
    EXPECT_LE(std::abs(found->value - every_pair(low, high)), found->error) << low_at << ", " << high_at;
    EXPECT_LT(found->error, low_at < -10 ? 0.03 : 0.0003) << "entropies below 2^-24 are ties";
  }
}

TEST(EntropyAuroc, ByHand) {
  const auto of = [](const Floats& low, const Floats& high) { return auroc(histogram(low), histogram(high))->value; };
  EXPECT_EQ(of({0.1F, 0.2F}, {0.5F, 3.0F}), 1);
  EXPECT_EQ(of({0.5F, 3.0F}, {0.1F, 0.2F}), 0);
  EXPECT_EQ(of({0.5F, 0, 0}, {0.5F, 0, 0}), 0.5) << "ties count one half";
  EXPECT_EQ(of({0, 1}, {0.5F, 2}), 0.75);
  EXPECT_EQ(of({-1e-9F, 0}, {1e-9F, 0}), 0.5) << "rounding below 0 is 0";
  EXPECT_EQ(of({0x1p-25F}, {0x1p-24F}), 1) << "the first bin ends at 2^-24";
  EXPECT_EQ(of({1}, {1 + 1 / 2048.0F}), 1) << "2,048 bins an octave";
  EXPECT_EQ(of({1}, {1 + 1 / 3000.0F}), 0.5);
  EXPECT_EQ(of({6.9F}, {6.94F}), 1) << "ln 1024 lies inside";
  EXPECT_EQ(of({9}, {100}), 0.5) << "above 8 nats all are one bin";
  EXPECT_EQ(auroc(histogram({1, 1, 2}), histogram({1, 3}))->error, 0.5 * 2 / 6) << "half of the pairs in one bin";
}

TEST(EntropyAuroc, IsNoneWithoutOneOfTheGroupsOrWithNan) {
  const EntropyHistogram some = histogram({0.5F}), none;
  EXPECT_FALSE(auroc(some, none));
  EXPECT_FALSE(auroc(none, some));
  EXPECT_FALSE(none.mean());
  const EntropyHistogram broken = histogram({0.5F, std::numeric_limits<float>::quiet_NaN()});
  EXPECT_EQ(broken.pixels(), 1);
  EXPECT_EQ(broken.nonfinite(), 1);
  EXPECT_FALSE(broken.mean());
  EXPECT_FALSE(auroc(some, broken));
  EXPECT_FALSE(auroc(broken, some));
}

TEST(EntropyAuroc, MergesInAnyOrderToTheSameBits) {
  const Floats low = entropies(999, -4, 3), high = entropies(500, -2, 4);
  std::vector<EntropyHistogram> parts;
  for (std::size_t begin = 0; begin < low.size(); begin += 111)
    parts.push_back(histogram(Floats(low.begin() + static_cast<std::ptrdiff_t>(begin),
                                     low.begin() + static_cast<std::ptrdiff_t>(begin + 111))));
  EntropyHistogram forward, backward;
  for (auto part = parts.begin(); part != parts.end(); ++part) forward.merge(*part);
  for (auto part = parts.rbegin(); part != parts.rend(); ++part) backward.merge(*part);
  const Auroc whole = *auroc(histogram(low), histogram(high));
  EXPECT_EQ(auroc(forward, histogram(high))->value, whole.value);
  EXPECT_EQ(auroc(backward, histogram(high))->value, whole.value);
  EXPECT_EQ(forward.pixels(), 999);
  EXPECT_NEAR(*forward.mean(), *histogram(low).mean(), 1e-12);
}

TEST(LabelEntropy, DropsVoidAndSplitsByWhetherTheLabelIsRight) {
  LabelEntropy found;
  // right 0.1, wrong 2, void truth, void prediction, right 1, wrong 0.5
  found.add(Floats{0.1F, 2, 0.7F, 0.7F, 1, 0.5F}, Labels{0, 1, 0, kV, 2, 0}, Labels{0, 0, kV, 0, 2, 2});
  EXPECT_EQ(found.right.pixels(), 2);
  EXPECT_EQ(found.wrong.pixels(), 2);
  EXPECT_NEAR(*found.wrong.mean(), 1.25, 1e-7);
  EXPECT_EQ(found.detects_wrong()->value, 0.75);
  LabelEntropy all_right;
  all_right.add(Floats{0.1F, 0.2F}, Labels{0, 1}, Labels{0, 1});
  EXPECT_FALSE(all_right.detects_wrong()) << "nothing to detect";
  LabelEntropy all_wrong;
  all_wrong.add(Floats{0.1F, 0.2F}, Labels{1, 0}, Labels{0, 1});
  EXPECT_FALSE(all_wrong.detects_wrong());
}

TEST(LabelEntropy, GroupsPixelsByTheLabelTheyTrainedWith) {
  LabelEntropy found;
  // right 0.1, wrong 2, unlabelled 1, void truth (labelled, and not), right 0.3
  found.add(Floats{0.1F, 2, 1, 0.7F, 0.7F, 0.3F}, Labels{0, 1, kV, 0, kV, 2}, Labels{0, 0, 0, kV, kV, 2});
  EXPECT_EQ(found.pixels(), 4);
  EXPECT_NEAR(*found.right.mean(), 0.2, 1e-7);
  EXPECT_EQ(*found.wrong.mean(), 2);
  EXPECT_EQ(*found.none.mean(), 1);
  EXPECT_EQ(found.detects_wrong()->value, 1);
  EXPECT_NEAR(found.detects_none()->value, 2.0 / 3, 1e-15) << "1 nat against 0.1, 2 and 0.3";
  LabelEntropy frame;  // without labels
  frame.add(Floats{3, 0.2F}, {}, Labels{1, kV});
  EXPECT_FALSE(frame.detects_none());
  found.merge(frame);
  EXPECT_EQ(found.none.pixels(), 2);
  EXPECT_EQ(*found.none.mean(), 2);
  EXPECT_NEAR(found.detects_none()->value, 5.0 / 6, 1e-15);
}

// Published protocols: which classes count, what is void, and a checksum of the truth.

ClassTable table() { return table_of_names({"void", "wall", "Night-Stand", "mug", "refridgerator"}); }

// Truth and prediction as rows of classes: 10 walls, 2 of them mugs; 4 stands, all right; 6 mugs, 5 of them walls.
ConfusionMatrix confusion() {
  ConfusionMatrix out(4);
  const auto add = [&](std::int16_t truth, std::int16_t predicted, int count) {
    const std::vector<std::int16_t> t(static_cast<std::size_t>(count), truth), p(t.size(), predicted);
    out.add(t, p);
  };
  add(0, 0, 8);
  add(0, 2, 2);
  add(1, 1, 4);
  add(2, 2, 1);
  add(2, 0, 5);
  return out;
}

TEST(Protocol, EveryClassOfTheSceneCounts) {
  for (const char* name : {"semantic_nerf", "panoptic_lifting"}) {
    const ProtocolScore score = protocol_score(protocol_named(name), confusion(), table());
    ASSERT_EQ(score.classes.size(), 4U);
    EXPECT_EQ(score.scored_px, 20);
    EXPECT_DOUBLE_EQ(*score.classes[0].iou, 8.0 / 15);
    EXPECT_FALSE(score.classes[3].iou) << "a class that is not in truth";
    EXPECT_DOUBLE_EQ(*score.miou, (8.0 / 15 + 1 + 1.0 / 8) / 3);
    EXPECT_DOUBLE_EQ(*score.total_accuracy, 13.0 / 20);
    EXPECT_DOUBLE_EQ(*score.average_accuracy, (0.8 + 1 + 1.0 / 6) / 3);
    EXPECT_DOUBLE_EQ(*score.miou, *confusion().miou_present());
  }
}

// A mug is no class of NYU40: true mugs are void, and a wall that is taken for one is wrong.
TEST(Protocol, WhatIsNotInTheListIsVoid) {
  const ProtocolScore score = protocol_score(protocol_named("nyu40"), confusion(), table());
  EXPECT_EQ(score.void_classes, std::vector<std::string>{"mug"});
  ASSERT_EQ(score.classes.size(), 3U) << "names are compared in small letters, without '-', and as ScanNet spells them";
  EXPECT_EQ(score.scored_px, 14);
  EXPECT_DOUBLE_EQ(*score.miou, (0.8 + 1) / 2);
  EXPECT_DOUBLE_EQ(*score.total_accuracy, 12.0 / 14);
  const ProtocolScore twenty = protocol_score(protocol_named("scannet20"), confusion(), table());
  EXPECT_EQ(twenty.void_classes, (std::vector<std::string>{"Night-Stand", "mug"}));
  EXPECT_DOUBLE_EQ(*twenty.miou, 0.8);
}

TEST(Protocol, WhatDoesNotFitIsNamed) {
  EXPECT_ERROR(protocol_named("ade20k"), "eval.protocol.unknown", "ade20k", "scannet20");
  const ClassTable mugs({{1, "mug", {}, false}});
  EXPECT_ERROR(protocol_score(protocol_named("nyu40"), ConfusionMatrix(1), mugs), "eval.protocol.classes", "mug");
  EXPECT_FALSE(protocol_score(protocol_named("semantic_nerf"), ConfusionMatrix(1), mugs).miou);
}

TEST(Protocol, TheTruthHasAChecksum) {
  std::vector<FrameInfo> infos(2);
  std::vector<StoredFrame> frames(2);
  const auto hash = [&](std::vector<std::int16_t> labels, const ClassTable& classes) {
    infos[1].name = "b";
    infos[1].camera.width_px = 2;
    infos[1].camera.height_px = 1;
    frames[1].label = LabelMap(labels);
    return truth_hash(std::vector<int>{1}, infos, frames, classes);
  };
  const ClassTable more({{0, "void", {}, true}, {1, "wall", {}, false}, {4, "refridgerator", {}, false}});
  const std::string first = hash({0, 3}, table());
  EXPECT_EQ(first.size(), 8U);
  EXPECT_EQ(first, hash({0, 1}, more)) << "ids count, and not their places in the table";
  EXPECT_NE(first, hash({0, kVoid}, table()));
  EXPECT_NE(first, hash({3, 0}, table()));
}

// final_eval.json and labels.json: made from scores, written, read back, and refused; and pictures of what is rendered.

const ClassEntry kWall{3, "wall \"a\"", {1, 2, 3}, false}, kChair{9, "chair", {7, 8, 9}, false};
const ClassTable kTable({{0, "void", {0, 0, 0}, true}, kWall, {7, "never", {4, 5, 6}, false}, kChair});

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

nlohmann::json sample_eval() {
  return nlohmann::json::parse(final_eval_json(sample_score(), kTable, "test", 400, 12.5));
}

TEST(FinalEval, KeepsPresentClassesAndBinsByHand) {
  const nlohmann::json eval = sample_eval();
  ASSERT_EQ(eval["classes"].size(), 2u) << "a class that occurs nowhere is not kept";
  EXPECT_EQ(eval["classes"][0]["id"], 3);
  EXPECT_EQ(eval["classes"][1]["name"], "chair");
  EXPECT_EQ(eval["classes"][1]["color"], kChair.color);
  EXPECT_EQ(eval["confusion"]["pixels"], (nlohmann::json{{2, 0}, {1, 1}})) << "row: truth, column: prediction";
  EXPECT_EQ(eval["confusion"]["void_truth_pixels"], 1);
  // 15 bins of width 1/15: 0.5 and 0.52 in (7/15, 8/15], 0.9 in (13/15, 14/15], 1 in the last.
  const nlohmann::json& bins = eval["reliability"]["bins"];
  ASSERT_EQ(bins.size(), 15u);
  EXPECT_EQ(bins[7]["pixels"], 2);
  EXPECT_NEAR(bins[7]["confidence"].get<double>(), 0.51, 1e-7);
  EXPECT_EQ(bins[7]["accuracy"], 1);
  EXPECT_EQ(bins[13]["accuracy"], 0);
  EXPECT_TRUE(bins[0]["accuracy"].is_null()) << "a bin without pixels has no accuracy";
  for (const std::size_t bin : {0, 13, 14}) EXPECT_EQ(bins[bin]["pixels"], bin == 0 ? 0 : 1) << bin;
  EXPECT_NEAR(eval["entropy"]["auroc"].get<double>(), 2.0 / 3, 1e-15)
      << "0.65 of the wrong chair against 0.7, 0.6 and 0.01";
  EXPECT_EQ(eval["entropy"]["auroc_error"], 0);
  EXPECT_EQ(eval["per_frame"][0]["frame"], "left/1");
  EXPECT_EQ(eval["per_frame"][0]["psnr"], "inf");
  EXPECT_TRUE(eval["per_frame"][0]["absrel"].is_null());
}

TEST(FinalEval, WithoutLabelsThereIsNoMatrixAndNoBin) {
  const std::string text = final_eval_json(SplitScore(0, 10), {}, "test", 7, 0);
  const nlohmann::json eval = nlohmann::json::parse(text);
  EXPECT_TRUE(eval["classes"].empty() && eval["reliability"]["bins"].empty() && eval["entropy"]["auroc"].is_null());
  EXPECT_EQ(check_final_eval(text, "x"), 7);
}

TEST(FinalEval, RefusesWhatItDidNotWrite) {
  const nlohmann::json good = sample_eval();
  const auto refused = [](const nlohmann::json& json) {
    return error_of(ErrorKind::data, [&] { (void)check_final_eval(json.dump(), "runs/a/final_eval.json"); });
  };
  const auto changed = [&](const char* pointer, const nlohmann::json& value) {
    nlohmann::json json = good;
    json[nlohmann::json::json_pointer(pointer)] = value;
    return refused(json);
  };
  ASSERT_EQ(check_final_eval(good.dump(), "x"), 400);
  nlohmann::json earlier = good;
  earlier.erase("entropy");
  EXPECT_EQ(refused(earlier), "") << "of a version that did not count it";
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
  EXPECT_THROW((void)check_final_eval("{", "x"), Error);
}

TEST(LabelCounts, AreSummedFromTheManifestAndComeBack) {
  SceneManifest manifest{
      .classes = 3, .train_class_pixels = {100, 0, 20}, .train_pixels = 1000, .train_frames = 10, .labelled_frames = 2};
  const std::vector<TrainingLabels::Step> steps{{"pixel_noise", {{"pixels changed", "12"}, {"seed", "3"}}}};
  const std::vector<SelfTrainingRound> rounds{{30, 400, 300, 0, 0}, {45, 400, 350, 200, 150}};
  const std::string json = label_counts_json(manifest, kTable, steps);
  const nlohmann::json counts = nlohmann::json::parse(json);
  EXPECT_EQ(counts["labelled_pixels"], 120);
  EXPECT_EQ(counts["labelled_frames"], 2);
  ASSERT_EQ(counts["classes"].size(), 3u);
  EXPECT_EQ(counts["classes"][2]["id"], 9);
  EXPECT_EQ(counts["degrade"][0]["facts"]["pixels changed"], "12");
  EXPECT_TRUE(check_label_counts(json, "labels.json").empty());
  EXPECT_THROW((void)check_label_counts("{\"train_frames\": -1}", "labels.json"), Error);
  EXPECT_THROW((void)check_label_counts("[]", "labels.json"), Error);
  const auto back = check_label_counts(label_counts_json(manifest, kTable, steps, rounds), "labels.json");
  EXPECT_EQ(back, rounds);
  EXPECT_FALSE(back[0].accuracy());
  EXPECT_HAS(back[1].text(), "step 45", "350 pixels", "87.5 %", "75.0 %");
  EXPECT_LACKS(json, "self_training");
  EXPECT_THROW((void)parse_rounds("[{\"step\": -1}]", "labels.json"), Error);
}

constexpr float kInf = std::numeric_limits<float>::infinity();

struct ImageOutput : ::testing::Test {
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

// Colours of a view under a map of its own.

constexpr std::int32_t kWidth = 8, kHeight = 6;

std::vector<float> picture(unsigned seed) {
  std::vector<float> colors;
  for (int i = 0; i < 3 * kWidth * kHeight; ++i)
    colors.push_back(0.5F + 0.4F * std::sin(static_cast<float>(i * (seed + 3)) * 0.37F));
  return colors;
}

// A gain, a mixture and an offset are undone to what the weak pull towards the identity leaves.
TEST(ColorFit, UndoesAnAffineMap) {
  const std::vector<float> truth = picture(1);
  std::vector<float> predicted(truth.size());
  for (std::size_t p = 0; p < truth.size(); p += 3) {
    predicted[p] = 0.8F * truth[p] + 0.05F * truth[p + 1] + 0.02F;
    predicted[p + 1] = 0.7F * truth[p + 1];
    predicted[p + 2] = 0.9F * truth[p + 2] - 0.03F;
  }
  const std::vector<float> fitted = fitted_by_halves(truth, predicted, kWidth);
  for (std::size_t i = 0; i < truth.size(); ++i) EXPECT_NEAR(fitted[i], truth[i], 0.02) << i;
}

// The map of a half has not seen it: a half that differs by a map of its own keeps its error.
TEST(ColorFit, AHalfIsNotScoredByAMapThatHasSeenIt) {
  const std::vector<float> truth = picture(2);
  std::vector<float> predicted = truth;
  for (std::int32_t y = 0; y < kHeight; ++y)
    for (std::int32_t x = 0; x < kWidth / 2; ++x)
      for (int c = 0; c < 3; ++c) predicted[static_cast<std::size_t>(3 * (y * kWidth + x) + c)] *= 0.5F;
  const std::vector<float> fitted = fitted_by_halves(truth, predicted, kWidth);
  for (std::int32_t y = 0; y < kHeight; ++y) {
    const auto left = static_cast<std::size_t>(3 * y * kWidth), right = left + 3 * (kWidth - 1);
    EXPECT_NEAR(fitted[left], 0.5 * truth[left], 0.02) << "as the right half has it: unchanged";
    EXPECT_GT(std::abs(fitted[right] - truth[right]), 0.3 * truth[right]) << "as the left half has it: doubled";
  }
}

TEST(ColorFit, LeavesOutWhatIsNotFiniteAndStandsOneColour) {
  std::vector<float> truth(picture(0).size(), 0.4F), predicted(truth.size(), 0.3F);
  predicted[5] = std::numeric_limits<float>::quiet_NaN();
  const std::vector<float> fitted = fitted_by_halves(truth, predicted, kWidth);
  EXPECT_TRUE(std::isnan(fitted[5]));
  EXPECT_NEAR(fitted[0], 0.4, 0.01);
}

}  // namespace
}  // namespace semfield
