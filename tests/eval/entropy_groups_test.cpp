// Entropy of groups of pixels against every pair compared by itself.
#include "eval/entropy_groups.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

namespace semfield {
namespace {

using Labels = std::vector<std::int16_t>;
using Floats = std::vector<float>;
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

TEST(PredictedEntropy, DropsVoidAndSplitsByWhetherTheLabelIsRight) {
  PredictedEntropy found;
  // right 0.1, wrong 2, void truth, void prediction, right 1, wrong 0.5
  found.add(Floats{0.1F, 2, 0.7F, 0.7F, 1, 0.5F}, Labels{0, 1, 0, kV, 2, 0}, Labels{0, 0, kV, 0, 2, 2});
  EXPECT_EQ(found.right.pixels(), 2);
  EXPECT_EQ(found.wrong.pixels(), 2);
  EXPECT_NEAR(*found.wrong.mean(), 1.25, 1e-7);
  EXPECT_EQ(found.detects_wrong()->value, 0.75);
  PredictedEntropy all_right;
  all_right.add(Floats{0.1F, 0.2F}, Labels{0, 1}, Labels{0, 1});
  EXPECT_FALSE(all_right.detects_wrong()) << "nothing to detect";
  PredictedEntropy all_wrong;
  all_wrong.add(Floats{0.1F, 0.2F}, Labels{1, 0}, Labels{0, 1});
  EXPECT_FALSE(all_wrong.detects_wrong());
}

TEST(GivenEntropy, GroupsPixelsByTheLabelTheyTrainedWith) {
  GivenEntropy found;
  // right 0.1, wrong 2, unlabelled 1, void truth (labelled, and not), right 0.3
  found.add(Floats{0.1F, 2, 1, 0.7F, 0.7F, 0.3F}, Labels{0, 1, kV, 0, kV, 2}, Labels{0, 0, 0, kV, kV, 2});
  EXPECT_EQ(found.pixels(), 4);
  EXPECT_NEAR(*found.right.mean(), 0.2, 1e-7);
  EXPECT_EQ(*found.wrong.mean(), 2);
  EXPECT_EQ(*found.none.mean(), 1);
  EXPECT_EQ(found.detects_wrong()->value, 1);
  EXPECT_NEAR(found.detects_none()->value, 2.0 / 3, 1e-15) << "1 nat against 0.1, 2 and 0.3";
  GivenEntropy frame;  // without labels
  frame.add(Floats{3, 0.2F}, {}, Labels{1, kV});
  EXPECT_FALSE(frame.detects_none());
  found.merge(frame);
  EXPECT_EQ(found.none.pixels(), 2);
  EXPECT_EQ(*found.none.mean(), 2);
  EXPECT_NEAR(found.detects_none()->value, 5.0 / 6, 1e-15);
}

}  // namespace
}  // namespace semfield
