// Segments made worse: shares, numbers, and the same again for the same seed.
#include <gtest/gtest.h>

#include <set>

#include "objects/object_score.h"

namespace semfield {
namespace {

// Ten bars, each 8 pixels wide, in two equal frames; bar k is of class k % 3.
SegmentSet bars() {
  SegmentSet set;
  FrameSegments frame{80, 40, {}, {}};
  for (int i = 0; i < 80 * 40; ++i) frame.id.push_back(1 + i % 80 / 8);
  for (int k = 1; k <= 10; ++k) frame.class_of[k] = static_cast<std::int16_t>(k % 3);
  set.frames = {frame, {}, frame};
  return set;
}

std::set<std::int32_t> ids_of(const FrameSegments& frame) { return {frame.id.begin(), frame.id.end()}; }

SegmentSet damaged(const SegmentDamage& damage, std::uint64_t seed = 1) {
  SegmentSet set = bars();
  damage_segments(set, damage, seed);
  return set;
}

TEST(SegmentDamage, NothingAskedForChangesNothing) {
  EXPECT_EQ(damaged({}).frames[0].id, bars().frames[0].id);
  EXPECT_FALSE(SegmentDamage{}.any());
}

TEST(SegmentDamage, ShuffledNumbersKeepPixelsAndClasses) {
  const SegmentSet set = damaged({.shuffle = true});
  const FrameSegments before = bars().frames[0], after = set.frames[0];
  EXPECT_NE(after.id, before.id);
  EXPECT_NE(after.id, set.frames[2].id) << "two frames have one order";
  EXPECT_EQ(ids_of(after), ids_of(before));
  for (int x = 0; x < 80; ++x) {
    EXPECT_EQ(after.id[static_cast<std::size_t>(x)], after.id[static_cast<std::size_t>(x / 8 * 8)]);
    EXPECT_EQ(after.class_of.at(after.id[static_cast<std::size_t>(x)]), (1 + x / 8) % 3);
  }
  EXPECT_EQ(damaged({.shuffle = true}).frames[0].id, after.id);
  EXPECT_NE(damaged({.shuffle = true}, 2).frames[0].id, after.id);
}

TEST(SegmentDamage, SharesAreOfTheSegmentsOfAnImage) {
  EXPECT_EQ(ids_of(damaged({.split = 0.2}).frames[0]).size(), 12u);
  EXPECT_EQ(ids_of(damaged({.missing = 0.3}).frames[0]).size(), 8u) << "seven, and what is missing";
  const std::size_t merged = ids_of(damaged({.merge = 0.2}).frames[0]).size();
  EXPECT_LT(merged, 10u);
  EXPECT_GE(merged, 8u);
}

TEST(SegmentDamage, HalvesOfASplitSegmentKeepItsClass) {
  const FrameSegments after = damaged({.split = 1}).frames[0];
  for (std::size_t i = 0; i < after.id.size(); ++i)
    EXPECT_EQ(after.class_of.at(after.id[i]), static_cast<int>(1 + i % 80 / 8) % 3);
}

TEST(SegmentDamage, BordersMoveByNoMoreThanIsAskedFor) {
  const FrameSegments after = damaged({.border_px = 2}).frames[0];
  int moved = 0;
  for (std::int32_t i = 0; i < 80 * 40; ++i) {
    const int x = i % 80, own = 1 + x / 8, left = 1 + std::max(0, x - 2) / 8, right = 1 + std::min(79, x + 2) / 8;
    const int id = after.id[static_cast<std::size_t>(i)];
    EXPECT_TRUE(id >= left && id <= right) << i;
    moved += id != own;
  }
  EXPECT_GT(moved, 100);
}

}  // namespace
}  // namespace semfield
