// Replica layout: camera, splits, sequences, label folders.
#include "datasets/replica/replica.h"

#include <gtest/gtest.h>

#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

TEST(Replica, PaperSplitCameraAndPixels) {
  const std::string folder = fresh_folder("room");
  std::filesystem::create_directories(folder + "/Sequence_1");
  write_replica(folder + "/Sequence_1", 8);
  ReplicaParams p;
  p.root = folder;
  Replica replica(p, {});
  Diagnostics d;
  const SceneInfo info = replica.open(d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.size(), 4u);  // 0 and 5 train, 2 and 7 test
  EXPECT_EQ(info.frames[1].name, "rgb_2");
  EXPECT_EQ(info.frames[1].split, Split::test);
  EXPECT_EQ(info.frames[2].split, Split::train);
  EXPECT_NEAR(info.frames[0].camera.fx, 20.0, 1e-12);
  EXPECT_EQ(info.frames[0].camera.cx, 20.0);
  FrameBuffer got;
  replica.read(2, got);
  const FrameBuffer want = render_room(room_camera(), room_pose(5));
  EXPECT_EQ(got.rgb, want.rgb);
  EXPECT_EQ(got.label, want.label);
  EXPECT_EQ(got.instance, want.instance);
  for (std::size_t i = 0; i < got.depth_m.size(); ++i) ASSERT_NEAR(got.depth_m[i], want.depth_m[i], 0.000501);
}

TEST(Replica, TestLabelsMayComeFromAnotherFolder) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 4);
  std::filesystem::create_directories(folder + "/cnn");
  for (int i = 0; i < 4; i += 2) {
    write_png_gray8(folder + "/cnn/semantic_class_" + std::to_string(i) + ".png", 40, 30,
                    std::vector<std::uint8_t>(1200, 3));
  }
  ReplicaParams p;
  p.root = folder;
  p.train_step = p.test_step = 2;
  p.test_offset = 1;
  p.label_dir = "cnn";
  p.test_label_dir = "semantic_class";
  Replica replica(p, {});
  Diagnostics d;
  (void)replica.open(d);
  EXPECT_FALSE(d.has_errors());
  FrameBuffer train, test;
  replica.read(0, train);
  replica.read(1, test);
  EXPECT_EQ(train.label, std::vector<std::int16_t>(1200, 2));
  EXPECT_EQ(test.label, render_room(room_camera(), room_pose(1)).label);
}

}  // namespace
}  // namespace semfield
