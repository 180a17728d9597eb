// The tree of things: what a click means, levels, and places that are part of it or not.

#include "surface/things.h"

#include <gtest/gtest.h>

#include <vector>

namespace semfield {
namespace {

constexpr std::int32_t kWidth = 120, kHeight = 90;

// A picture of boxes, and the surface in it: a wall 3 m off, and boxes before it.
struct Boxes {
  struct Box {
    std::int32_t x0, y0, x1, y1;
    std::uint8_t grey;
    double before_m = 0;  // of the wall
  };
  std::vector<std::uint8_t> rgb = std::vector<std::uint8_t>(3 * kWidth * kHeight, 200);
  SeenSurface surface;

  explicit Boxes(const std::vector<Box>& boxes) {
    std::vector<Vec3d> place(kWidth * kHeight);
    for (std::int32_t y = 0; y < kHeight; ++y) {
      for (std::int32_t x = 0; x < kWidth; ++x) {
        const std::int32_t at = y * kWidth + x;
        double z = 3;
        for (const Box& box : boxes) {
          if (x < box.x0 || x >= box.x1 || y < box.y0 || y >= box.y1) continue;
          z = 3 - box.before_m;
          for (std::int32_t c = 0; c < 3; ++c) rgb[3 * at + c] = box.grey;
        }
        place[at] = Vec3d{(x - 60) / 100.0, (y - 45) / 100.0, 1} * z;
      }
    }
    surface = seen_surface(std::move(place), kWidth, {});
  }
  ThingTree tree(bool with_surface = true, std::span<const std::int32_t> segment = {}) const {
    return ThingTree({kWidth, kHeight, rgb, with_surface ? &surface : nullptr, segment});
  }
};

// Of two boxes that touch, and one apart.
const std::vector<Boxes::Box> kTwo{{30, 30, 55, 70, 40, 0}, {55, 30, 80, 70, 120, 0}};

double overlap(const Thing& thing, std::int32_t x0, std::int32_t y0, std::int32_t x1, std::int32_t y1) {
  double both = 0, any = 0;
  for (std::int32_t y = 0; y < kHeight; ++y) {
    for (std::int32_t x = 0; x < kWidth; ++x) {
      const bool a = thing.mask[y * kWidth + x], b = x >= x0 && x < x1 && y >= y0 && y < y1;
      both += a && b ? 1 : 0;
      any += a || b ? 1 : 0;
    }
  }
  return both / any;
}

Thing choose(const ThingTree& tree, std::vector<PixelPlace> also, std::vector<PixelPlace> without = {}, int level = 0) {
  return tree.choose(also, without, level);
}

TEST(Things, BoxesThatTouchAreApartByTheirColours) {
  for (const bool with_surface : {true, false}) {
    const ThingTree tree = Boxes(kTwo).tree(with_surface);
    EXPECT_EQ(overlap(choose(tree, {{42, 50}}), 30, 30, 55, 70), 1) << with_surface;
    EXPECT_EQ(overlap(choose(tree, {{67, 50}}), 55, 30, 80, 70), 1) << with_surface;
  }
}

TEST(Things, AStepOfDepthPartsWhatLooksAlike) {
  const Boxes boxes({{40, 30, 80, 70, 200, 0.8}});
  EXPECT_GT(overlap(choose(boxes.tree(), {{60, 50}}), 40, 30, 80, 70), 0.9);
  EXPECT_LT(overlap(choose(boxes.tree(false), {{60, 50}}), 40, 30, 80, 70), 0.2) << "there is nothing to see";
}

TEST(Things, TheWallIsAllThatIsNoThing) {
  const Thing wall = choose(Boxes(kTwo).tree(), {{100, 20}});
  EXPECT_TRUE(wall.mask[10 * kWidth + 10]);
  EXPECT_FALSE(wall.mask[50 * kWidth + 42]);
  EXPECT_FALSE(wall.mask[50 * kWidth + 67]);
  EXPECT_NEAR(wall.share, 1 - 2000.0 / (kWidth * kHeight), 1e-9);
}

TEST(Things, LevelsGrowFromAPartToAll) {
  const ThingTree tree = Boxes(kTwo).tree();
  const Thing one = choose(tree, {{42, 50}});
  EXPECT_EQ(one.level, 0);
  double before = 0;
  for (int level = one.least; level <= one.most; ++level) {
    const Thing thing = choose(tree, {{42, 50}}, {}, level);
    EXPECT_EQ(thing.level, level);
    EXPECT_GE(thing.share, 1.2 * before);
    before = thing.share;
  }
  EXPECT_GT(before, 1 / 1.2) << "the last one is the whole picture, or nearly";
  EXPECT_EQ(choose(tree, {{42, 50}}, {}, 1000).level, one.most);
  EXPECT_EQ(choose(tree, {{42, 50}}, {}, -1000).level, one.least);
}

TEST(Things, OtherPlacesAddAndTakeAway) {
  const ThingTree tree = Boxes(kTwo).tree();
  EXPECT_EQ(overlap(choose(tree, {{42, 50}, {67, 50}}), 30, 30, 80, 70), 1);
  EXPECT_EQ(overlap(choose(tree, {{42, 50}, {67, 50}}, {{70, 40}}), 30, 30, 55, 70), 1);
  // A place that is part of it and one that is not, in one region: the later kind has the region.
  EXPECT_EQ(choose(tree, {{42, 50}}, {{42, 50}}).share, 0);
}

// Segments of another program part what looks alike, join what does not, and leave the rest to the picture.
TEST(Things, KeepToTheBordersOfSegments) {
  std::vector<std::int32_t> segment(kWidth * kHeight, 0);
  for (std::int32_t y = 30; y < 70; ++y) {
    for (std::int32_t x = 30; x < 80; ++x) segment[y * kWidth + x] = 4;   // both boxes
    for (std::int32_t x = 90; x < 110; ++x) segment[y * kWidth + x] = 7;  // of the wall
  }
  const Boxes boxes(kTwo);
  const ThingTree tree = boxes.tree(true, segment);
  EXPECT_EQ(overlap(choose(tree, {{42, 50}}), 30, 30, 80, 70), 1) << "one thing of two colours";
  EXPECT_EQ(overlap(choose(tree, {{100, 50}}), 90, 30, 110, 70), 1) << "nothing is to be seen there";
  const Thing wall = choose(tree, {{15, 15}});
  EXPECT_NEAR(wall.share, 1 - 2800.0 / (kWidth * kHeight), 1e-9);
  EXPECT_EQ(overlap(choose(tree, {{42, 50}, {100, 50}}), 30, 30, 80, 70), 2000.0 / 2800) << "both";
  const std::vector<std::int32_t> none(kWidth * kHeight, 0);
  EXPECT_EQ(choose(boxes.tree(true, none), {{42, 50}}).mask, choose(boxes.tree(), {{42, 50}}).mask);
}

TEST(Things, APictureOfOnePixelIsOneThing) {
  const std::vector<std::uint8_t> rgb{1, 2, 3};
  const Thing thing = choose(ThingTree({1, 1, rgb, nullptr}), {{0, 0}}, {}, 3);
  EXPECT_EQ(thing.mask, std::vector<bool>{true});
  EXPECT_EQ(thing.least, 0);
  EXPECT_EQ(thing.most, 0);
}

}  // namespace
}  // namespace semfield
