// Label selection: exact counts, spacing, determinism, refusals.
#include "labels/label_selection.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <set>

#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;

// 180 training frames 0, 5, ..., 895 and as many test frames, as in the paper.
SceneInfo paper_split() {
  SceneInfo info;
  for (int i = 0; i < 900; ++i) {
    if (i % 5 != 0 && i % 5 != 2) continue;
    FrameInfo f;
    f.name = "rgb_" + std::to_string(i);
    f.split = i % 5 == 0 ? Split::train : Split::test;
    f.has_labels = true;
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
  LabelParams p;
  p.frames = "10%";
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 18u);
  for (std::size_t k = 0; k < keep.size(); ++k)
    EXPECT_EQ(info.frames[static_cast<std::size_t>(keep[k])].name, "rgb_" + std::to_string(50 * k));
}

TEST(LabelSelection, RandomIsSeededWithoutRepeats) {
  const SceneInfo info = paper_split();
  LabelParams p;
  p.mode = LabelMode::random;
  p.frames = "18";
  const std::vector<int> a = select_label_frames(info, p);
  EXPECT_EQ(a, select_label_frames(info, p));
  EXPECT_EQ(std::set<int>(a.begin(), a.end()).size(), 18u);
  for (const int i : a) EXPECT_EQ(info.frames[static_cast<std::size_t>(i)].split, Split::train);
  p.seed = 2;
  EXPECT_NE(a, select_label_frames(info, p));
  p.seed = 1;
  p.frames = "40";
  const std::vector<int> larger = select_label_frames(info, p);
  for (const int i : a) EXPECT_TRUE(std::binary_search(larger.begin(), larger.end(), i));
}

TEST(LabelSelection, NamedFrames) {
  SceneInfo info = paper_split();
  LabelParams p;
  p.mode = LabelMode::named;
  p.names = {"rgb_100", "rgb_0", "rgb_100"};
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 2u);
  EXPECT_EQ(info.frames[static_cast<std::size_t>(keep[1])].name, "rgb_100");
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
  EXPECT_EQ(message("25"),
            "scene.labels.frames: 25 asked for, 20 labelled training frames are there; ask for fewer, or write all");
  const std::string want = "scene.labels.frames: expected all, none, a share such as 10%, or a number, got '";
  for (const char* bad : {"", "some", "-1", "101%", "%", "10 %", "nan%"})
    EXPECT_EQ(message(bad), want + bad + "'; write for example 10%");
  Diagnostics d;
  LabelParams p;
  p.mode = LabelMode::named;
  validate(p, d);
  EXPECT_EQ(d.error_count(), 1);
}

// Frame 0 shows classes 0 and 1, frame 1 class 2 alone, frame 2 classes 0, 1 and 3: 2 first, then 1.
TEST(LabelSelection, CoverageTakesTheFrameThatShowsMostNewClasses) {
  SceneInfo info;
  for (int i = 0; i < 4; ++i) {
    FrameInfo f;
    f.has_labels = true;
    f.split = i == 3 ? Split::test : Split::train;
    info.frames.push_back(f);
  }
  const std::vector<std::vector<std::int64_t>> pixels{
      {9, 9, 0, 0, 0}, {0, 0, 1, 0, 30}, {1, 1, 0, 1, 0}, {5, 5, 5, 5, 5}};
  LabelParams p;
  p.mode = LabelMode::coverage;
  p.frames = "1";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{2}));
  p.frames = "2";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{1, 2}));
  p.frames = "3";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{0, 1, 2}));
}

}  // namespace
}  // namespace semfield
