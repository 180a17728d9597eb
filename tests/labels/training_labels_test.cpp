// Which labels train: the scene's own or those of files, scaled, selected, degraded; the truth stays.
#include "labels/training_labels.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>

namespace semfield {
namespace {

ClassTable two_classes() {
  return ClassTable({{0, "void", {}, true}, {4, "wall", {}, false}, {9, "chair", {}, false}});
}

// Frames a and b train, t tests; 4 x 2 pixels.
LoadedScene tiny_scene(bool with_labels) {
  LoadedScene scene;
  if (with_labels) scene.info.classes = two_classes();
  for (const char* name : {"a", "b", "t"}) {
    FrameInfo f;
    f.name = name;
    f.camera.width_px = 4;
    f.camera.height_px = 2;
    f.has_labels = with_labels;
    f.split = f.name == "t" ? Split::test : Split::train;
    scene.info.frames.push_back(f);
    FrameBuffer b;
    b.width_px = 4;
    b.height_px = 2;
    b.rgb.assign(24, 0);
    if (with_labels) b.label = {0, 0, 1, kVoid, 1, 1, 1, 1};
    scene.frames.emplace_back(b);
    scene.class_pixels.push_back(with_labels ? std::vector<std::int64_t>{2, 5, 1} : std::vector<std::int64_t>{});
  }
  return scene;
}

// 8 x 4 pixels, twice the frames' size: class 1 in the right half.
struct Files final : LabelReader {
  bool soft = false;
  std::int32_t width = 8;
  void describe(ParamVisitor&) override {}
  ClassTable open(const ClassTable&, Diagnostics&) override { return two_classes(); }
  bool has(const FrameInfo& frame) const override { return frame.name != "a"; }
  LabelRaster read(const FrameInfo&, const ClassTable& classes) const override {
    LabelRaster out{width, 4, {}, {}};
    for (int i = 0; i < 4 * width; ++i) {
      const int c = i % width < width / 2 ? 0 : 1;
      if (soft) {
        for (int k = 0; k < classes.valid_count(); ++k) out.soft.push_back(k == c ? 0.5F : 0.25F);
      } else {
        out.hard.push_back(static_cast<std::int16_t>(c));
      }
    }
    return out;
  }
};

struct VoidFirst final : Degradation {
  void describe(ParamVisitor&) override {}
  StepFacts apply(const LoadedScene&, std::uint64_t seed, LabelSet& labels) const override {
    for (FrameLabels& f : labels) {
      if (!f.hard.empty()) f.hard[0] = kVoid;
    }
    return {{"seed", std::to_string(seed)}};
  }
};

LabelConfig files_config(bool soft = false, std::int32_t width = 8) {
  LabelConfig config;
  auto reader = std::make_unique<Files>();
  reader->soft = soft;
  reader->width = width;
  config.from = {"files", std::move(reader)};
  return config;
}

TEST(TrainingLabels, AreTheScenesOwnWithoutAnyStep) {
  const LoadedScene scene = tiny_scene(true);
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, LabelConfig{}, d);
  EXPECT_EQ(labels.frames[0].hard, scene.frames[0].label);
  EXPECT_TRUE(labels.frames[2].empty()) << "a test frame does not train";
  EXPECT_EQ(labels.class_pixels[0], (std::vector<std::int64_t>{2, 5, 1}));
  EXPECT_FALSE(labels.soft);
}

TEST(TrainingLabels, SelectionAndDegradationLeaveTheTruthAlone) {
  const LoadedScene scene = tiny_scene(true);
  LabelConfig config;
  config.selection.frames = "1";
  config.selection.seed = 7;
  config.degrade.push_back({"void_first", std::make_unique<VoidFirst>()});
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_EQ(labels.frames[0][0], kVoid);
  EXPECT_EQ(labels.frames[0][1], 0);
  EXPECT_TRUE(labels.frames[1].empty());
  EXPECT_EQ(scene.frames[0].label[0], 0);
  ASSERT_EQ(labels.steps.size(), 1u);
  EXPECT_EQ(labels.steps[0].facts[0].second, "7");
  EXPECT_EQ(labels.class_pixels[0], (std::vector<std::int64_t>{1, 5, 2}));
}

TEST(TrainingLabels, ATypeNamedAgainDrawsAnew) {
  const LoadedScene scene = tiny_scene(true);
  LabelConfig config;
  config.selection.seed = 7;
  for (const char* type : {"void_first", "other", "void_first"})
    config.degrade.push_back({type, std::make_unique<VoidFirst>()});
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_EQ(labels.steps[0].facts[0].second, "7");
  EXPECT_EQ(labels.steps[1].facts[0].second, "7");
  EXPECT_EQ(labels.steps[2].facts[0].second, std::to_string(7 + (std::int64_t{1} << 53)));
}

TEST(TrainingLabels, FilesReplaceTrainingLabelsAndGiveTestFramesTheirTruth) {
  LoadedScene scene = tiny_scene(false);
  LabelConfig config = files_config();
  Diagnostics d;
  open_label_files(scene, config, d);
  EXPECT_EQ(scene.info.classes.valid_count(), 2);
  read_test_labels(scene, config, d);
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_TRUE(labels.frames[0].empty());
  const LabelMap halves(std::vector<std::int16_t>{0, 0, 1, 1, 0, 0, 1, 1});
  EXPECT_EQ(labels.frames[1].hard, halves);
  EXPECT_TRUE(labels.frames[2].empty());
  EXPECT_EQ(scene.frames[2].label, halves);
  EXPECT_TRUE(scene.info.frames[2].has_labels);
  // A scene with its own labels keeps them as the truth.
  LoadedScene own = tiny_scene(true);
  read_test_labels(own, config, d);
  EXPECT_EQ(own.frames[2].label[3], kVoid);
  EXPECT_EQ(make_training_labels(own, config, d).frames[1].hard, halves);
}

TEST(TrainingLabels, SoftFilesCountTheMostProbableClass) {
  LoadedScene scene = tiny_scene(true);
  const LabelConfig config = files_config(true);
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_TRUE(labels.soft);
  EXPECT_EQ(labels.frames[1][0], 0);
  EXPECT_EQ(labels.frames[1][3], 1);
  EXPECT_EQ(labels.frames[1].soft.at(0, 1), 0.25F);
  EXPECT_EQ(labels.class_pixels[1], (std::vector<std::int64_t>{4, 4, 0}));
}

TEST(TrainingLabels, LabelsOfAnotherShapeAreRefusedNamingTheFrame) {
  LoadedScene scene = tiny_scene(true);
  const LabelConfig config = files_config(false, 16);
  Diagnostics d;
  EXPECT_THROW((void)make_training_labels(scene, config, d), Error);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_EQ(d.all()[0].text(),
            "frame 'b': labels are 16 x 4 pixels, the frame is 4 x 2: another shape; label the image of this frame");
}

TEST(SoftMap, HalvesAreNearestAndExact) {
  for (std::uint32_t h = 0; h < 0x10000u; ++h) {
    const float f = float_of_half(static_cast<std::uint16_t>(h));
    if (std::isnan(f)) continue;
    ASSERT_EQ(half_of(f), h);
  }
  EXPECT_EQ(half_of(65519.0F), 0x7BFF);
  EXPECT_EQ(half_of(65520.0F), 0x7C00);
  EXPECT_EQ(half_of(1.0F + 0x1p-11F), 0x3C00) << "a tie goes to the even half";
  EXPECT_EQ(half_of(1.0F + 3 * 0x1p-11F), 0x3C02);
  EXPECT_EQ(half_of(0x1.8p-25F), 1);  // subnormal
  EXPECT_TRUE(std::isnan(float_of_half(half_of(NAN))));
}

TEST(SoftMap, RefusesWhatIsNoProbability) {
  SoftMap map(2, 2);
  map.set_row(1, std::array<float, 2>{0.2F, 0.6F});
  EXPECT_EQ(map.argmax(0), kVoid);
  EXPECT_EQ(map.argmax(1), 1);
  EXPECT_THROW(map.set_row(0, std::array<float, 2>{-0.1F, 1}), Error);
  EXPECT_THROW(map.set_row(0, std::array<float, 2>{NAN, 1}), Error);
}

}  // namespace
}  // namespace semfield
