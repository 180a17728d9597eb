// Real predictions of networks through the label readers, where they are at hand.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "datasets/replica/replica.h"
#include "datasets/transforms_json/transforms_json.h"
#include "formats/image_io.h"
#include "tests/labels/reader_case.h"

namespace semfield {
namespace {

using namespace testing_labels;

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

TEST(RealLabels, HardPredictionsOfReplicaFrames) {
  const std::string root = data("replica_apartment0");
  if (!std::filesystem::exists(root + "/cnn_strong")) GTEST_SKIP() << "the optional Replica frames are not at hand";
  ReplicaParams p;
  p.root = root;
  p.train_step = 2;
  p.test_step = 2;
  p.test_offset = 1;
  Replica replica(p, {});
  Diagnostics d;
  const SceneInfo info = replica.open(d);
  auto reader = make_reader("images", "folder: " + root + "/cnn_strong\npattern: 'semantic_class_{number}.png'\n");
  const ClassTable table = reader->open(info.classes, d);
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
  TransformsJsonParams p;
  p.root = root;
  TransformsJson scene(p, {});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  auto reader = make_reader("npz", "folder: " + root + "/predictions\n");
  const ClassTable table = reader->open(info.classes, d);
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
        const std::int16_t label = truth.label[static_cast<std::size_t>(ty * truth.width_px + tx)];
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
