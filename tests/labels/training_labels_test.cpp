// Which labels train: the scene's own or those of files, scaled, selected, degraded; the truth stays.
#include "labels/training_labels.h"

#include <algorithm>
#include <set>

#include "labels/label_files.h"
#include "tests/scene/tiny_scene.h"

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
    FrameInfo f{.name = name, .camera = {.width_px = 4, .height_px = 2}, .has_labels = with_labels};
    f.split = f.name == "t" ? Split::test : Split::train;
    scene.info.frames.push_back(f);
    FrameBuffer b{.width_px = 4, .height_px = 2};
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
  LabelConfig config{.selection = {.frames = "1", .seed = 7}};
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
  LabelConfig config{.selection = {.seed = 7}};
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

// Label selection: exact counts, spacing, determinism, refusals.

// 180 training frames 0, 5, ..., 895 and as many test frames, as in the paper.
SceneInfo paper_split() {
  SceneInfo info;
  for (int i = 0; i < 900; ++i) {
    if (i % 5 != 0 && i % 5 != 2) continue;
    FrameInfo f{
        .name = "rgb_" + std::to_string(i), .split = i % 5 == 0 ? Split::train : Split::test, .has_labels = true};
    info.frames.push_back(f);
  }
  return info;
}

TEST(LabelSelection, CountsAreExact) {
  EXPECT_EQ(label_frame_count("all", 180), 180);
  EXPECT_EQ(label_frame_count("none", 180), 0);
  EXPECT_EQ(label_frame_count("10%", 180), 18);
  EXPECT_EQ(label_frame_count("5%", 180), 9);
  EXPECT_EQ(label_frame_count("0.1%", 180), 1);
  EXPECT_EQ(label_frame_count("0%", 180), 0);
  EXPECT_EQ(label_frame_count("100%", 180), 180);
  EXPECT_EQ(label_frame_count("2", 180), 2);
  EXPECT_EQ(label_frame_count("10%", 0), 0);
}

TEST(LabelSelection, EvenKeyFramesAreSpacedAndOnlyTrainingFrames) {
  const SceneInfo info = paper_split();
  LabelParams p{.frames = "10%"};
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 18u);
  for (std::size_t k = 0; k < keep.size(); ++k) EXPECT_EQ(info.frames[keep[k]].name, "rgb_" + std::to_string(50 * k));
}

TEST(LabelSelection, RandomIsSeededWithoutRepeats) {
  const SceneInfo info = paper_split();
  LabelParams p{.frames = "18", .mode = LabelMode::random};
  const std::vector<int> a = select_label_frames(info, p);
  EXPECT_EQ(a, select_label_frames(info, p));
  EXPECT_EQ(std::set<int>(a.begin(), a.end()).size(), 18u);
  for (const int i : a) EXPECT_EQ(info.frames[i].split, Split::train);
  p.seed = 2;
  EXPECT_NE(a, select_label_frames(info, p));
  p.seed = 1;
  p.frames = "40";
  const std::vector<int> larger = select_label_frames(info, p);
  for (const int i : a) EXPECT_TRUE(std::binary_search(larger.begin(), larger.end(), i));
}

TEST(LabelSelection, NamedFrames) {
  SceneInfo info = paper_split();
  LabelParams p{.mode = LabelMode::named, .names = {"rgb_100", "rgb_0", "rgb_100"}};
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 2u);
  EXPECT_EQ(info.frames[keep[1]].name, "rgb_100");
  p.names = {"rgb_2"};
  EXPECT_EQ(error_of([&] { (void)select_label_frames(info, p); }),
            "scene.labels.names: frame 'rgb_2' is not a training frame; name training frames only");
  info.frames[0].has_labels = false;
  p.names = {"rgb_0"};
  EXPECT_EQ(error_of([&] { (void)select_label_frames(info, p); }),
            "scene.labels.names: frame 'rgb_0' has no labels; name frames that have a label image");
}

TEST(LabelSelection, RefusalsAreExact) {
  const auto message = [](const std::string& frames) { return error_of([&] { (void)label_frame_count(frames, 20); }); };
  EXPECT_EQ(
      message("25"),
      "scene.labels.frames: 25 were asked for, and there are 20 labelled training frames; ask for fewer, or write all");
  const std::string want = "scene.labels.frames: expected all, none, a share such as 10%, or a number, got '";
  for (const char* bad : {"", "some", "-1", "101%", "%", "10 %", "nan%"})
    EXPECT_EQ(message(bad), want + bad + "'; write for example 10%");
  Diagnostics d;
  LabelParams p{.mode = LabelMode::named};
  validate(p, d);
  EXPECT_EQ(d.error_count(), 1);
}

// Frame 0 shows classes 0 and 1, frame 1 class 2 alone, frame 2 classes 0, 1 and 3: 2 first, then 1.
TEST(LabelSelection, CoverageTakesTheFrameThatShowsMostNewClasses) {
  SceneInfo info;
  for (int i = 0; i < 4; ++i) {
    FrameInfo f{.split = i == 3 ? Split::test : Split::train, .has_labels = true};
    info.frames.push_back(f);
  }
  const std::vector<std::vector<std::int64_t>> pixels{
      {9, 9, 0, 0, 0}, {0, 0, 1, 0, 30}, {1, 1, 0, 1, 0}, {5, 5, 5, 5, 5}};
  LabelParams p{.frames = "1", .mode = LabelMode::coverage};
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{2}));
  p.frames = "2";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{1, 2}));
  p.frames = "3";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{0, 1, 2}));
}

}  // namespace
}  // namespace semfield
