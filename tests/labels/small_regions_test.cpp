// Speckles are given to what surrounds them, and nothing else changes; label files of real scenes.
#include <algorithm>

#include "core/rng.h"
#include "datasets/replica/replica.h"
#include "datasets/transforms_json/transforms_json.h"
#include "formats/image_io.h"
#include "labels/mask_outlines.h"
#include "scene/scene.h"
#include "tests/labels/reader_case.h"

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
        ASSERT_EQ(label[run.y * kWidth + x], region.index) << x << " " << run.y;
    }
  }
  EXPECT_EQ(found.regions, small);
  EXPECT_GT(small, 100);
  EXPECT_GT(large, 10);
  for (const MaskRegion& region : mask_regions(label, kWidth, kHeight)) EXPECT_GE(region.area_px, kArea);
}

// Real predictions of networks through the label readers, where they are at hand.

using namespace testing_labels;

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

TEST(RealLabels, HardPredictionsOfReplicaFrames) {
  const std::string root = data("replica_apartment0");
  if (!std::filesystem::exists(root + "/cnn_strong")) GTEST_SKIP() << "the optional Replica frames are not at hand";
  ReplicaParams p{.root = root, .train_step = 2, .test_step = 2, .test_offset = 1};
  Replica replica(p, {});
  Diagnostics d;
  const SceneInfo info = replica.open(d);
  auto reader = make_reader("images", "folder: " + root + "/cnn_strong\npattern: 'semantic_class_{number}.png'\n");
  const ClassTable table = reader->open(info.classes, d);
  reader->match(info.frames, d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.size(), 70u);
  std::int64_t same = 0, counted = 0;
  for (std::size_t f = 0; f < info.frames.size(); ++f) {
    ASSERT_TRUE(reader->has(info.frames[f])) << info.frames[f].name;
    const LabelRaster raster = reader->read(info.frames[f], table);
    ASSERT_EQ(raster.width_px, 320);
    FrameBuffer truth;
    replica.read(static_cast<int>(f), truth);
    for (std::size_t i = 0; i < truth.label.size(); ++i) {
      if (truth.label[i] < 0 || raster.hard[i] < 0) continue;
      ++counted;
      same += truth.label[i] == raster.hard[i];
    }
  }
  // The data's own description says 85.9 % of pixels; a frame taken for its neighbour would lose several per cent.
  const double accuracy = static_cast<double>(same) / static_cast<double>(counted);
  EXPECT_NEAR(accuracy, 0.859, 0.01);
  RecordProperty("accuracy", std::to_string(accuracy));
}

TEST(RealLabels, SoftPredictionsOfTheShelfBin) {
  const std::string root = data("shelf_bin");
  if (!std::filesystem::exists(root + "/predictions")) GTEST_SKIP() << "the optional shelf bin is not at hand";
  TransformsJsonParams p{.root = root};
  TransformsJson scene(p, {});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  auto reader = make_reader("npz", "folder: " + root + "/predictions\n");
  const ClassTable table = reader->open(info.classes, d);
  reader->match(info.frames, d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.size(), 15u);
  const auto classes = static_cast<std::size_t>(table.valid_count());
  ASSERT_EQ(classes, 4u);
  std::int64_t same = 0, counted = 0;
  double highest = 0;
  for (std::size_t f = 0; f < info.frames.size(); ++f) {
    ASSERT_TRUE(reader->has(info.frames[f])) << info.frames[f].name;
    const LabelRaster raster = reader->read(info.frames[f], table);
    ASSERT_EQ(raster.width_px, 320);
    ASSERT_EQ(raster.height_px, 240);
    ASSERT_EQ(raster.soft.size(), 320u * 240 * 4);
    FrameBuffer truth;
    scene.read(static_cast<int>(f), truth);
    for (std::int32_t y = 0; y < 240; ++y) {
      for (std::int32_t x = 0; x < 320; ++x) {
        const auto row = raster.soft.begin() + (std::int64_t{y} * 320 + x) * 4;
        float sum = 0;
        for (std::int64_t c = 0; c < 4; ++c) sum += row[c];
        highest = std::max(highest, static_cast<double>(sum));
        const std::int64_t ty = std::int64_t{2 * y + 1} * truth.height_px / 480,
                           tx = std::int64_t{2 * x + 1} * truth.width_px / 640;
        const std::int16_t label = truth.label[ty * truth.width_px + tx];
        if (label < 0 || sum < 0.5F) continue;
        ++counted;
        same += std::max_element(row, row + 4) - row == label;
      }
    }
  }
  EXPECT_LE(highest, 1.01);
  const double accuracy = static_cast<double>(same) / static_cast<double>(counted);
  EXPECT_GT(accuracy, 0.7);
  RecordProperty("accuracy", std::to_string(accuracy));
  std::printf("shelf bin: %lld pixels of objects, %.3f of them predicted right, sums up to %.4f\n",
              static_cast<long long>(counted), accuracy, highest);
}

}  // namespace
}  // namespace semfield
