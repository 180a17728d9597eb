// Speckles are given to what surrounds them, and nothing else changes.
#include "labels/small_regions.h"

#include <gtest/gtest.h>

#include <string>

#include "core/rng.h"
#include "labels/mask_outlines.h"
#include "scene/scene.h"

namespace semfield {
namespace {

std::vector<std::int16_t> map_of(const std::vector<std::string>& rows) {
  std::vector<std::int16_t> label;
  for (const std::string& row : rows) {
    for (const char c : row) label.push_back(c == '.' ? kVoid : static_cast<std::int16_t>(c - '0'));
  }
  return label;
}

TEST(SmallRegions, TakeTheClassAroundThem) {
  std::vector<std::int16_t> label = map_of({
      "1111122222",
      "1311122.22",  // a speckle, and one of void
      "1111152222",  // between two classes, equally near: the one that comes first
      "1134112222",  // two speckles side by side
      "1111122222",
  });
  const SmallRegions found = fill_small_regions(label, 10, 5, 3);
  EXPECT_EQ(label, map_of({
                       "1111122222",
                       "1111122222",
                       "1111122222",
                       "1111112222",
                       "1111122222",
                   }));
  EXPECT_EQ(found.regions, 5);
  EXPECT_EQ(found.pixels, 5);
}

TEST(SmallRegions, ConnectionThroughCornersIsNone) {
  std::vector<std::int16_t> label = map_of({"1000", "0100", "0010", "0000"});
  EXPECT_EQ(fill_small_regions(label, 4, 4, 3).pixels, 3) << "three regions of a pixel each";
  EXPECT_EQ(label, map_of({"0000", "0000", "0000", "0000"}));
}

TEST(SmallRegions, AreaIsTheFirstThatStays) {
  const std::vector<std::int16_t> before = map_of({"00000", "01100", "00000"});
  std::vector<std::int16_t> label = before;
  for (const std::int64_t area : {0, 1, 2}) {
    EXPECT_EQ(fill_small_regions(label, 5, 3, area).pixels, 0) << area;
    EXPECT_EQ(label, before) << area;
  }
  EXPECT_EQ(fill_small_regions(label, 5, 3, 3).pixels, 2);
}

TEST(SmallRegions, AMapOfSmallRegionsAloneStays) {
  const std::vector<std::int16_t> before = map_of({"0101", "1010"});
  std::vector<std::int16_t> label = before;
  const SmallRegions found = fill_small_regions(label, 4, 2, 2);
  EXPECT_EQ(found.regions, 0);
  EXPECT_EQ(label, before);
}

// Blocks of four classes under single pixels of noise: every region from the area on keeps each of its pixels, and none
// below it is left.
TEST(SmallRegions, NoRegionFromTheAreaOnChanges) {
  constexpr std::int32_t kWidth = 61, kHeight = 47;
  constexpr std::int64_t kArea = 12;
  const RandomAddress address{3, 0, stream_id("test")};
  std::vector<std::int16_t> label;
  for (std::int32_t y = 0; y < kHeight; ++y) {
    for (std::int32_t x = 0; x < kWidth; ++x) {
      const std::uint64_t pixel = static_cast<std::uint64_t>(y * kWidth + x);
      const bool noise = uniform_below(address, 2 * pixel, 100) < 25;
      const auto block = static_cast<std::uint64_t>(1000000 + x / 9 * 100 + y / 7);
      label.push_back(static_cast<std::int16_t>(uniform_below(address, noise ? 2 * pixel + 1 : block, 4)));
    }
  }
  const std::vector<std::int16_t> before = label;
  const SmallRegions found = fill_small_regions(label, kWidth, kHeight, kArea);
  std::int64_t small = 0, large = 0;
  for (const MaskRegion& region : mask_regions(before, kWidth, kHeight)) {
    if (region.area_px < kArea) {
      ++small;
      continue;
    }
    ++large;
    for (const PixelRun& run : outline_runs(region.outline, kWidth, kHeight)) {
      for (std::int32_t x = run.x0; x < run.x1; ++x)
        ASSERT_EQ(label[static_cast<std::size_t>(run.y * kWidth + x)], region.index) << x << " " << run.y;
    }
  }
  EXPECT_EQ(found.regions, small);
  EXPECT_GT(small, 100);
  EXPECT_GT(large, 10);
  for (const MaskRegion& region : mask_regions(label, kWidth, kHeight)) EXPECT_GE(region.area_px, kArea);
}

}  // namespace
}  // namespace semfield
