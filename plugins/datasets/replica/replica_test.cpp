// Replica layout: camera, splits, sequences, label folders.
#include <clocale>

#include "core/error.h"
#include "labels/training_labels.h"
#include "loading/frame_source.h"
#include "tests/datasets/named_dataset.h"
#include "tests/labels/reader_case.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

NamedDataset even_odd(const std::string& folder, testkit::Settings settings = {}) {
  settings.insert({{"root", folder}, {"train_step", "2"}, {"test_step", "2"}, {"test_offset", "1"}});
  return NamedDataset("replica", settings);
}

TEST(Replica, PaperSplitCameraAndPixels) {
  const std::string folder = fresh_folder("room");
  std::filesystem::create_directories(folder + "/Sequence_1");
  write_replica(folder + "/Sequence_1", 8);
  NamedDataset replica("replica", {{"root", folder}, {"split", "paper"}});
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

// traj.txt, results/frame000000.jpg and depth000000.png of 6553.5 steps a metre.
TEST(Replica, TheLayoutOfNiceSlam) {
  const std::string above = fresh_folder("slam"), folder = above + "/room0";
  std::filesystem::create_directories(folder + "/results");
  std::string poses;
  for (int i = 0; i < 3; ++i) {
    const FrameBuffer f = render_room(room_camera(), room_pose(i));
    std::vector<std::uint16_t> steps;
    for (const float d : f.depth_m) steps.push_back(static_cast<std::uint16_t>(std::lround(d * 6553.5)));
    const std::string n = "00000" + std::to_string(i) + ".png";
    write_png_rgb(folder + "/results/frame" + n, 40, 30, f.rgb);
    write_png_gray16(folder + "/results/depth" + n, 40, 30, steps);
    poses += pose_line(room_pose(i));
  }
  plain_write(folder + "/traj.txt", poses);
  const Recognised found("replica", folder);
  EXPECT_HAS(found.what, "traj.txt");
  EXPECT_EQ(found.root, folder);
  NamedDataset scene("replica", {{"root", folder}, {"test_every", "0"}});
  const auto lens = [&] {
    Diagnostics d;
    const SceneInfo info = scene.open(d);
    EXPECT_FALSE(d.has_errors()) << d.all()[0].text();
    EXPECT_EQ(info.frames.size(), 3u);
    EXPECT_TRUE(info.metric);
    EXPECT_EQ(info.frames[2].name, "frame000002");
    const Camera& c = info.frames[0].camera;
    return std::vector<double>{std::round(1e9 * c.fx) / 1e9, c.fy, c.cx, c.cy};
  };
  const std::vector<double> usual = lens();  // 90 degrees
  EXPECT_EQ(usual[0], 20);
  EXPECT_NEAR(usual[1], 20, 1e-9);
  EXPECT_EQ(usual[3], 15);
  FrameBuffer got;
  scene.read(2, got);
  const FrameBuffer want = render_room(room_camera(), room_pose(2));
  for (std::size_t i = 0; i < got.depth_m.size(); ++i) ASSERT_NEAR(got.depth_m[i], want.depth_m[i], 1e-4);
  // Of images twice as large.
  plain_write(
      above + "/cam_params.json",
      "{\"camera\": {\"w\": 80, \"h\": 60, \"fx\": 44, \"fy\": 42, \"cx\": 39.5, \"cy\": 29.5, \"scale\": 3276.75}}");
  EXPECT_EQ(lens(), (std::vector<double>{22, 21, 20, 15}));
  scene.read(2, got);
  EXPECT_NEAR(got.depth_m[0], 2 * want.depth_m[0], 1e-3);
  plain_write(above + "/cam_params.json", "{}");
  Diagnostics d;
  scene.open(d);
  EXPECT_EQ(d.error_count(), 1);
}

TEST(Replica, EveryFrameIsInOneSplitByDefault) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 10);
  testkit::Settings settings{{"root", folder}};
  const auto splits = [&] {
    Diagnostics d;
    std::string out;
    for (const FrameInfo& f : NamedDataset("replica", settings).open(d).frames)
      out += f.split == Split::test ? 'T' : '.';
    EXPECT_TRUE(d.all().empty()) << d.all()[0].text();
    return out;
  };
  EXPECT_EQ(splits(), "T.......T.");
  settings["test_every"] = "0";
  EXPECT_EQ(splits(), "..........");
  settings["test_step"] = "4";
  settings["test_offset"] = "3";
  EXPECT_EQ(splits(), "...T...T..");
}

TEST(Replica, MissingFilesAreLeftOutWhereAskedAndMoveNoOtherFrame) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 10);
  for (const char* gone : {"/rgb/rgb_3.png", "/rgb/rgb_8.png", "/depth/depth_1.png"})
    std::filesystem::remove(folder + gone);
  Diagnostics d;
  NamedDataset replica("replica", {{"root", folder}, {"missing", "skip"}});
  const LoadedScene scene = load_scene(replica, {}, d);
  ASSERT_FALSE(d.has_errors()) << d.all()[0].text();
  EXPECT_HAS(all_said(d), "2 frames are left out", "rgb_3, rgb_8", "1 of 8 frames", "rgb_1");
  ASSERT_EQ(scene.info.frames.size(), 8u);
  EXPECT_FALSE(scene.info.frames[1].has_depth);
  EXPECT_EQ(scene.frames_of(Split::test), std::vector<int>{0});  // 8 is gone, 9 has not taken its place
}

TEST(Replica, TestLabelsMayComeFromAnotherFolder) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 4);
  std::filesystem::create_directories(folder + "/cnn");
  for (int i = 0; i < 4; i += 2)
    write_png_gray8(folder + "/cnn/semantic_class_" + std::to_string(i) + ".png", 40, 30,
                    std::vector<std::uint8_t>(1200, 3));
  NamedDataset replica = even_odd(folder, {{"label_dir", "cnn"}, {"test_label_dir", "semantic_class"}});
  Diagnostics d;
  (void)replica.open(d);
  EXPECT_FALSE(d.has_errors());
  FrameBuffer train, test;
  replica.read(0, train);
  replica.read(1, test);
  EXPECT_EQ(train.label, std::vector<std::int16_t>(1200, 2));
  EXPECT_EQ(test.label, render_room(room_camera(), room_pose(1)).label);
}

// Frames 0 and 4 of 0, 2, 4 have noisy labels (class id 3 everywhere), one name with zeros, one without a prefix.
std::string write_noise(const std::string& name) {
  const std::string folder = fresh_folder(name);
  write_replica(folder, 6);
  const std::string noise = folder + "/semantic_instance_noise/sort_0.5";
  std::filesystem::create_directories(noise);
  write_png_gray8(noise + "/semantic_class_00000.png", 40, 30, std::vector<std::uint8_t>(1200, 3));
  write_png_gray8(noise + "/4.png", 40, 30, std::vector<std::uint8_t>(1200, 3));
  write_png_gray8(noise + "/vis_sem_class_2.png", 40, 30, std::vector<std::uint8_t>(1200, 3));  // a preview
  return folder;
}

TEST(Replica, NestedLabelFoldersOfTrainingFramesWithOrWithoutZeros) {
  NamedDataset replica = even_odd(write_noise("room"), {{"label_dir", "semantic_instance_noise/sort_0.5"}});
  Diagnostics d;
  const SceneInfo info = replica.open(d);
  EXPECT_HAS(all_said(d), "sort_0.5: 1 of 3 training frames have no label image");
  for (const int i : {0, 4}) {
    FrameBuffer pixels;
    replica.read(i, pixels);
    EXPECT_EQ(pixels.label, std::vector<std::int16_t>(1200, 2)) << i;
  }
  EXPECT_FALSE(info.frames[2].has_labels);
  for (const int i : {1, 3, 5}) {  // the folder has none of them: semantic_class tells
    FrameBuffer pixels;
    replica.read(i, pixels);
    EXPECT_EQ(pixels.label, render_room(room_camera(), room_pose(i)).label) << i;
  }
}

TEST(Replica, LabelFoldersThatHoldNothingOrTwoOfAFrame) {
  const std::string folder = write_noise("room");
  std::string label_dir = "semantic_instance_noise";
  Diagnostics none;
  even_odd(folder, {{"label_dir", label_dir}}).open(none);
  ASSERT_TRUE(none.has_errors());
  EXPECT_HAS(none.all()[0].text(), folder + "/semantic_instance_noise", "no label image", "semantic_class_<i>.png");
  label_dir += "/sort_0.5";
  for (const char* name : {"/04.png", "/004.png", "/0004.png"})
    write_png_gray8(folder + "/" + label_dir + name, 40, 30, std::vector<std::uint8_t>(1200, 3));
  Diagnostics twice;
  even_odd(folder, {{"label_dir", label_dir}}).open(twice);
  EXPECT_EQ(twice.error_count(), 3);
  // In the order of their names, whatever that of the file system is.
  std::string wanted;
  for (const std::string name : {"004", "04", "4"})
    wanted += folder + "/" + label_dir + ": '0004.png' and '" + name +
              ".png' are labels of the same frame; keep one of the two\n";
  EXPECT_HAS(texts(twice), wanted);
}

// Degraded labels that only train: the scene's own stay the truth of every pose.
TEST(Replica, NoiseFolderTrainsWhileCleanLabelsStayTheTruth) {
  const std::string folder = write_noise("room");
  NamedDataset replica = even_odd(folder);
  Diagnostics d;
  LoadedScene scene = load_scene(replica, {}, d);
  LabelConfig config;
  config.from.type = "images";
  config.from.reader = testing_labels::make_reader(
      "images",
      "{folder: \"" + folder + "/semantic_instance_noise/sort_0.5\", pattern: 'semantic_class_{number}.png'}");
  open_label_files(scene, config, d);
  read_test_labels(scene, config, d);
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(labels.frames.size(), 6u);
  EXPECT_EQ(labels.frames[0].hard.expand(), std::vector<std::int16_t>(1200, 2));
  EXPECT_TRUE(labels.frames[2].empty());
  EXPECT_TRUE(labels.frames[4].empty());  // "4.png" is not of the pattern
  for (std::size_t i = 0; i < 6; ++i)
    EXPECT_EQ(scene.frames[i].label.expand(), render_room(room_camera(), room_pose(static_cast<int>(i))).label) << i;
}

// The program around may have taken over its user's locale, in which a number's fraction stands behind a comma.
TEST(Replica, PosesDoNotDependOnTheLocale) {
  const std::string folder = write_noise("room");
  Diagnostics d;
  const SceneInfo plain = even_odd(folder).open(d);
  if (std::setlocale(LC_ALL, "de_DE.UTF-8") == nullptr)
    GTEST_SKIP() << "the locale de_DE.UTF-8 is not installed here: no comma was tried";
  const SceneInfo german = even_odd(folder).open(d);
  std::setlocale(LC_ALL, "C");
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(german.frames.size(), plain.frames.size());
  for (std::size_t i = 0; i < plain.frames.size(); ++i) {
    const Pose &a = german.frames[i].world_from_camera, &b = plain.frames[i].world_from_camera;
    EXPECT_EQ(a.r, b.r);
    EXPECT_EQ((std::array{a.t.x, a.t.y, a.t.z}), (std::array{b.t.x, b.t.y, b.t.z}));
  }
}

}  // namespace
}  // namespace semfield
