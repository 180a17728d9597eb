// Every degradation on cases small enough to be worked out by hand, and the exact counts that it promises.
#include <algorithm>
#include <set>

#include "tests/labels/degradation_testing.h"

namespace semfield {
namespace {

using namespace testing_degrade;
using Labels = std::vector<std::int16_t>;

constexpr std::int16_t V = kVoid;

std::int64_t count(const Labels& labels, std::int16_t value) { return std::count(labels.begin(), labels.end(), value); }

// Frame of one class, which is the last of the table: pixels that were drawn and got another one can be recognised.
Case one_colour(int classes, int width, int height) {
  Case c = scene_of(classes);
  Labels all;
  for (int k = 0; k < classes; ++k) all.push_back(static_cast<std::int16_t>(k));
  c.add(classes, 1, all);  // the scene has every class
  c.labels[0] = {};
  c.add(width, height, Labels(static_cast<std::size_t>(width * height), static_cast<std::int16_t>(classes - 1)));
  return c;
}

TEST(PixelNoise, CountIsTheFloorOfAreaTimesRatio) {
  for (const auto& [ratio, expected] :
       std::vector<std::pair<std::string, int>>{{"0.5", 31}, {"0.9", 56}, {"0", 0}, {"1", 63}, {"0.3333", 20}}) {
    Case c = one_colour(3, 9, 7);
    const StepFacts facts = c.apply(*step("pixel_noise", "{ratio: " + ratio + "}"));
    EXPECT_EQ(fact(facts, "pixels drawn"), std::to_string(expected)) << ratio;
  }
  Case c = one_colour(3, 10, 10);  // 0.29 * 100 is 28.999999999999996 in double
  EXPECT_EQ(fact(c.apply(*step("pixel_noise", "{ratio: 0.29}")), "pixels drawn"), "29");
}

TEST(PixelNoise, DrawnPixelsAreDistinct) {
  // With all pixels drawn, one drawn twice would leave another with its label. Of 100,000 pixels with 999 classes, void
  // and the own class, each value has 1/1000 of the pixels: the own one about 100, not 100,000 / e.
  Case c = one_colour(999, 400, 250);
  c.apply(*step("pixel_noise", "{ratio: 1}"));
  EXPECT_NEAR(count(c.labels[1].hard, 998), 100, 50);
}

TEST(PixelNoise, ClassesAndVoidAreEquallyLikely) {
  Case c = one_colour(9, 300, 200);
  c.apply(*step("pixel_noise", "{ratio: 1}"));
  double chi_square = 0;
  for (std::int16_t k = kVoid; k < 9; ++k) {
    const double d = static_cast<double>(count(c.labels[1].hard, k)) - 6000;
    chi_square += d * d / 6000;
  }
  EXPECT_LT(chi_square, 27.88) << "0.1 % of fair draws with 9 degrees of freedom are above";
}

TEST(PixelNoise, PlacesAreEquallyLikely) {
  Case c = one_colour(3, 40, 10);
  for (int i = 0; i < 999; ++i) c.add(40, 10, Labels(400, 2));
  c.apply(*step("pixel_noise", "{ratio: 0.25}"));
  std::vector<double> changed(400);
  double sum = 0;
  for (std::size_t f = 1; f < c.labels.size(); ++f) {
    for (std::size_t p = 0; p < 400; ++p) changed[p] += c.labels[f].hard[p] != 2 ? 1 : 0;
  }
  for (const double n : changed) sum += n;
  const double mean = sum / 400;
  EXPECT_NEAR(mean, 1000 * 0.25 * 0.75, 5);
  double chi_square = 0;
  for (const double n : changed) chi_square += (n - mean) * (n - mean) / (mean * (1 - mean / 1000));
  EXPECT_LT(chi_square, 399 + 3.1 * std::sqrt(2 * 399.0));
  EXPECT_GT(chi_square, 399 - 3.1 * std::sqrt(2 * 399.0));
}

TEST(PixelNoise, VoidPixelsAreDrawnButStayVoidUnlessTold) {
  Case c = one_colour(3, 10, 10);
  std::fill(c.labels[1].hard.begin(), c.labels[1].hard.begin() + 40, V);
  Case flipped = c;
  EXPECT_EQ(fact(c.apply(*step("pixel_noise", "{ratio: 1}")), "void pixels drawn and left void"), "40");
  EXPECT_EQ(std::count(c.labels[1].hard.begin(), c.labels[1].hard.begin() + 40, V), 40);
  EXPECT_EQ(fact(flipped.apply(*step("pixel_noise", "{ratio: 1, flip_void: true}")), "void pixels drawn and left void"),
            "0");
  EXPECT_LT(std::count(flipped.labels[1].hard.begin(), flipped.labels[1].hard.begin() + 40, V), 25);
}

TEST(PixelNoise, ALargerRatioTakesTheSamePixelsAndMore) {
  Case half = one_colour(3, 30, 20), most = one_colour(3, 30, 20);
  half.apply(*step("pixel_noise", "{ratio: 0.5}"));
  most.apply(*step("pixel_noise", "{ratio: 0.9}"));
  for (std::size_t p = 0; p < 600; ++p) {
    if (half.labels[1].hard[p] != 2) {
      EXPECT_EQ(half.labels[1].hard[p], most.labels[1].hard[p]);
    }
  }
}

TEST(PixelNoise, DrawsOnlyClassesThatTheSceneHas) {
  Case c = scene_of(50);
  c.add(40, 30, Labels(1200, 7));
  c.scene.class_pixels[0][11] = 1;
  c.apply(*step("pixel_noise", "{ratio: 1}"));
  const std::set<std::int16_t> found(c.labels[0].hard.begin(), c.labels[0].hard.end());
  EXPECT_EQ(found, (std::set<std::int16_t>{V, 7, 11}));
}

// Instance 5 covers 1, 2, 3, 4, 5, 6 of 10 pixels in frames 3, 1, 5, 0, 2, 4; instance 9 one pixel in frames 0 and 1.
Case instances() {
  Case c = scene_of(4);
  const int areas[6] = {4, 2, 5, 1, 6, 3};
  for (int f = 0; f < 6; ++f) {
    Labels label(10, 0);
    std::vector<std::int32_t> instance(10, 0);
    for (std::size_t p = 0; p < static_cast<std::size_t>(areas[f]); ++p) {
      label[p] = 1;
      instance[p] = 5;
    }
    if (f < 2) {
      label[9] = 2;
      instance[9] = 9;
    }
    c.add(5, 2, label, instance);
  }
  c.scene.class_pixels[0][3] = 1;  // so the wrong class of instance 5 may be 0, 2 or 3
  return c;
}

// Frames in which the instance's first pixel is no longer of class `own`.
std::vector<int> flipped_frames(const Case& c, std::size_t pixel, std::int16_t own) {
  std::vector<int> out;
  for (std::size_t f = 0; f < c.labels.size(); ++f) {
    if (c.scene.frames[f].instance[pixel] != 0 && c.labels[f].hard[pixel] != own) out.push_back(static_cast<int>(f));
  }
  return out;
}

TEST(RegionNoise, SortFlipsTheSmallestAndEvenSpacesTheRanks) {
  Case sorted = instances();
  const StepFacts facts = sorted.apply(*step("region_noise", "{ratio: 0.5, instances: [5]}"));
  EXPECT_EQ(flipped_frames(sorted, 0, 1), (std::vector<int>{1, 3, 5}));  // areas 2, 1, 3
  EXPECT_EQ(fact(facts, "instances chosen"), "5");
  EXPECT_EQ(fact(facts, "views of them (an instance in a frame)"), "6");
  EXPECT_EQ(fact(facts, "views flipped"), "3");
  EXPECT_EQ(fact(facts, "pixels changed"), "6");
  Case even = instances();
  even.apply(*step("region_noise", "{ratio: 0.5, mode: even, instances: [5]}"));
  EXPECT_EQ(flipped_frames(even, 0, 1), (std::vector<int>{0, 1, 4}));  // ranks 1, 3, 5: areas 2, 4, 6
  Case third = instances();
  third.apply(*step("region_noise", "{ratio: 0.3333, mode: even, instances: [5]}"));
  EXPECT_EQ(flipped_frames(third, 0, 1), (std::vector<int>{1, 2}));  // ranks 1, 4
}

TEST(RegionNoise, TheWholeMaskGetsOneOtherClassAndNothingElseChanges) {
  std::set<std::int16_t> drawn;
  for (std::uint64_t seed = 1; seed <= 40; ++seed) {
    Case c = instances();
    const Case clean = c;
    c.apply(*step("region_noise", "{ratio: 1, instances: [5]}"), seed);
    for (std::size_t f = 0; f < 6; ++f) {
      const std::int16_t wrong = c.labels[f].hard[0];
      EXPECT_NE(wrong, 1);
      drawn.insert(wrong);
      for (std::size_t p = 0; p < 10; ++p)
        EXPECT_EQ(c.labels[f].hard[p], c.scene.frames[f].instance[p] == 5 ? wrong : clean.labels[f].hard[p]);
    }
  }
  EXPECT_EQ(drawn, (std::set<std::int16_t>{0, 2, 3}));
}

TEST(RegionNoise, InstancesAreChosenByClassAndNumberOfFrames) {
  Case c = instances();
  EXPECT_EQ(fact(c.apply(*step("region_noise", "{min_frames: 1}")), "instances chosen"), "5, 9");
  c = instances();
  EXPECT_EQ(fact(c.apply(*step("region_noise", "{min_frames: 3}")), "instances chosen"), "5");
  c = instances();
  EXPECT_EQ(fact(c.apply(*step("region_noise", "{classes: [class_2]}")), "instances chosen"), "9");
}

TEST(RegionNoise, RefusalsAreExact) {
  const auto message = [](const std::string& keys) {
    Case c = instances();
    return error_of([&] { c.apply(*step("region_noise", keys)); });
  };
  EXPECT_EQ(message("{instances: [6]}"),
            "region_noise.instances: no labelled training frame sees instance 6; there are 5, 9");
  EXPECT_EQ(message("{classes: [class_22]}"),
            "region_noise.classes: the class table has no class 'class_22'; did you mean 'class_2'?");
  EXPECT_HAS(message("{min_frames: 7}"), "region_noise", "7 labelled training frames", "lower its min_frames");
  Case without = scene_of(2);
  without.add(2, 1, {0, 1});
  EXPECT_EQ(error_of([&] { without.apply(*step("region_noise")); }),
            "region_noise: frame 'rgb_0' has no instance image; use a scene whose dataset reads instances "
            "(docs/reference/plugins.md says which do), or another degradation");
  Case single = scene_of(1);
  single.add(2, 1, {0, 0}, {1, 1});
  EXPECT_EQ(error_of([&] { single.apply(*step("region_noise")); }),
            "region_noise: the scene has one class, so no label can be a wrong one; remove this degradation");
  EXPECT_TRUE(step("region_noise")->needs_instances());
}

TEST(SuperResolution, DenseSpreadsTheMiddlePixelOfEachCell) {
  Case c = scene_of(8);
  c.add(5, 3,
        {0, 1, 2, 3, 4,  //
         5, 6, 7, 0, 1,  //
         2, 3, V, 5, 6});
  c.apply(*step("super_resolution", "{factor: 2}"));
  // Cells of columns 0-1, 2-3, 4 and rows 0-1, 2; their middle pixels are columns 1, 3, 4 and rows 1, 2.
  EXPECT_EQ(c.labels[0].hard, (Labels{6, 6, 0, 0, 1,  //
                                      6, 6, 0, 0, 1,  //
                                      3, 3, V, 5, 6}));
}

TEST(SuperResolution, SparseKeepsRowsAndColumnsDivisibleByTheFactor) {
  Case c = scene_of(8);
  c.add(5, 3,
        {0, 1, 2, 3, 4,  //
         5, 6, 7, 0, 1,  //
         2, 3, V, 5, 6});
  const StepFacts facts = c.apply(*step("super_resolution", "{factor: 2, mode: sparse}"));
  EXPECT_EQ(c.labels[0].hard, (Labels{0, V, 2, V, 4,  //
                                      V, V, V, V, V,  //
                                      2, V, V, V, 6}));
  EXPECT_EQ(fact(facts, "labelled pixels after"), "5");
  Case large = one_colour(3, 320, 240);
  large.apply(*step("super_resolution", "{factor: 16, mode: sparse}"));
  EXPECT_EQ(count(large.labels[1].hard, 2), 20 * 15);
}

// Pixels of `label` that are connected with its first one.
std::int64_t connected(const Labels& labels, int width, std::int16_t label) {
  const auto size = static_cast<int>(labels.size());
  std::set<int> reached;
  std::vector<int> todo{static_cast<int>(std::find(labels.begin(), labels.end(), label) - labels.begin())};
  while (!todo.empty()) {
    const int p = todo.back();
    todo.pop_back();
    if (p < 0 || p >= size || labels[p] != label || !reached.insert(p).second) continue;
    if (p % width != 0) todo.push_back(p - 1);
    if (p % width != width - 1) todo.push_back(p + 1);
    todo.push_back(p - width);
    todo.push_back(p + width);
  }
  return static_cast<std::int64_t>(reached.size());
}

// Left half class 0, right half class 1, a few pixels of class 2 apart from each other, a void row.
Case halves(int width, int height) {
  Case c = scene_of(3);
  Labels label;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const bool dot = x % 4 == 1 && y % 5 == 2;
      label.push_back(y == 0 ? V : dot ? std::int16_t{2} : static_cast<std::int16_t>(2 * x >= width));
    }
  }
  c.add(width, height, label);
  return c;
}

TEST(Propagation, AClickIsOnePixelOfEachClass) {
  std::set<std::size_t> clicks;
  for (std::uint64_t seed = 1; seed <= 50; ++seed) {
    Case c = halves(32, 20);
    const Labels clean = c.labels[0].hard;
    const StepFacts facts = c.apply(*step("propagation"), seed);
    const Labels& kept = c.labels[0].hard;
    for (std::int16_t k = 0; k < 3; ++k) EXPECT_EQ(count(kept, k), 1);
    for (std::size_t p = 0; p < kept.size(); ++p) {
      if (kept[p] != V) {
        EXPECT_EQ(kept[p], clean[p]);
      }
      if (kept[p] == 0) clicks.insert(p);
    }
    EXPECT_EQ(fact(facts, "clicks (a class of a frame)"), "3");
  }
  EXPECT_GT(clicks.size(), 40u) << "clicks fall anywhere in the class";
}

TEST(Propagation, AShareIsExactAndConnected) {
  for (const double share : {0.01, 0.05, 0.1, 0.5}) {
    Case c = halves(32, 20);
    const Labels clean = c.labels[0].hard;
    c.apply(*step("propagation", "{share: " + std::to_string(share) + "}"));
    for (std::int16_t k = 0; k < 2; ++k) {
      const auto wanted = std::max(
          std::int64_t{1}, static_cast<std::int64_t>(std::lround(share * static_cast<double>(count(clean, k)))));
      EXPECT_EQ(count(c.labels[0].hard, k), wanted) << share;
      EXPECT_EQ(connected(c.labels[0].hard, 32, k), wanted) << share;
    }
  }
}

TEST(Propagation, ASmallComponentIsFollowedByTheNextInReadingOrder) {
  // Class 0 in pieces of one pixel, class 1 between them: 6 pieces, half of them kept, from the click on.
  for (std::uint64_t seed = 1; seed <= 20; ++seed) {
    Case c = scene_of(2);
    c.add(4, 3, {0, 1, 0, 1, 1, 0, 1, 0, 0, 1, 0, 1});
    const std::vector<std::size_t> pieces{0, 2, 5, 7, 8, 10};
    const StepFacts facts = c.apply(*step("propagation", "{share: 0.5}"), seed);
    std::string kept;
    for (const std::size_t p : pieces) kept += c.labels[0].hard[p] == 0 ? 'x' : '.';
    EXPECT_HAS((kept + kept), "xxx...") << kept;
    EXPECT_EQ(fact(facts, "regions, where one was too small for the share"), "6");  // three of each class
  }
}

TEST(Propagation, ALargerShareContainsTheSmaller) {
  Case small = halves(32, 20), large = halves(32, 20);
  small.apply(*step("propagation", "{share: 0.05}"));
  large.apply(*step("propagation", "{share: 0.2}"));
  for (std::size_t p = 0; p < small.labels[0].hard.size(); ++p) {
    if (small.labels[0].hard[p] != V) {
      EXPECT_EQ(small.labels[0].hard[p], large.labels[0].hard[p]);
    }
  }
}

TEST(Propagation, AllOfAClassMayBeKept) {
  Case c = halves(32, 20);
  const Labels clean = c.labels[0].hard;
  c.apply(*step("propagation", "{share: 1}"));
  EXPECT_EQ(c.labels[0].hard, clean);
}

}  // namespace
}  // namespace semfield
