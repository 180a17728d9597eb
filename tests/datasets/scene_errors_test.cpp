// Broken scenes and the exact sentences that they get: place, cause, remedy.
#include "datasets/replica/replica.h"
#include "datasets/transforms_json/transforms_json.h"
#include "loading/frame_source.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

ReplicaParams even_odd(const std::string& folder) {
  return ReplicaParams{.root = folder, .train_step = 2, .test_step = 2, .test_offset = 1};
}

// Every error and warning of loading the folder, one per line.
std::vector<std::string> findings(const ReplicaParams& p) {
  Replica replica(p, {});
  Diagnostics d;
  (void)load_scene(replica, {}, d);
  std::vector<std::string> out;
  for (const Diagnostic& x : d.all()) {
    if (x.severity != Severity::note) out.push_back(x.text());
  }
  return out;
}

std::string frame_text(const std::string& folder, int i) {
  return "frame 'rgb_" + std::to_string(i) + "' (" + folder + "/rgb/rgb_" + std::to_string(i) + ".png): ";
}

TEST(SceneErrors, HealthyFolderHasNone) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 4);
  EXPECT_EQ(findings(even_odd(folder)), std::vector<std::string>{});
}

TEST(SceneErrors, AllTroubleOfAllFramesInOnePass) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  std::filesystem::remove(folder + "/rgb/rgb_0.png");
  std::filesystem::remove(folder + "/depth/depth_1.png");
  write_png_gray8(folder + "/semantic_class/semantic_class_2.png", 20, 15, std::vector<std::uint8_t>(300, 1));
  cut(folder + "/depth/depth_3.png", 16);
  std::vector<std::uint8_t> ids(1200, 1);
  ids[41 * 1 + 2] = 200;
  write_png_gray8(folder + "/semantic_class/semantic_class_4.png", 40, 30, ids);
  const std::string f = folder + "/", way_on =
                                          "restore the file, drop the frame from the index, or leave out what is "
                                          "missing with --set scene.missing=skip";
  const std::vector<std::string> found = findings(even_odd(folder));
  ASSERT_EQ(found.size(), 5u);
  EXPECT_EQ(found[0], frame_text(folder, 0) + "colour image '" + f + "rgb/rgb_0.png' is missing; " + way_on);
  EXPECT_EQ(found[1], frame_text(folder, 1) + "depth image '" + f + "depth/depth_1.png' is missing; " + way_on);
  EXPECT_EQ(found[2],
            frame_text(folder, 2) + "label image '" + f +
                "semantic_class/semantic_class_2.png' is 20 x 15 pixels, the camera 40 x 30; colour, depth and "
                "labels of a frame need the size that its camera states; labels of another one are scaled with --set "
                "'scene.label_dir=\"\"' --set 'scene.labels.from={type: images, folder: \"" +
                f + "semantic_class\", pattern: \"semantic_class_{number}.png\"}'");
  EXPECT_EQ(found[3].find(frame_text(folder, 3) + "'" + f + "depth/depth_3.png': PNG is truncated: "), 0u) << found[3];
  EXPECT_EQ(found[4], frame_text(folder, 4) + "label id 200 is not in the class table, first at x 3, y 1 of '" + f +
                          "semantic_class/semantic_class_4.png'; " + kUnknownLabelRemedy);
}

TEST(SceneErrors, UnknownLabelsCanBeVoid) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 2);
  write_png_gray8(folder + "/semantic_class/semantic_class_0.png", 40, 30, std::vector<std::uint8_t>(1200, 99));
  ReplicaParams p = even_odd(folder);
  p.unknown_labels = UnknownLabels::as_void;
  Replica replica(p, {});
  Diagnostics d;
  const LoadedScene s = load_scene(replica, {}, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(s.class_pixels[0].back(), 1200);
}

TEST(SceneErrors, PosesOfATrajectory) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 4);
  std::string text = pose_line(room_pose(0)) + "nan nan nan nan nan nan nan nan nan nan nan nan 0 0 0 1\n" + "1 2 3\n" +
                     "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1\n";
  write_file_atomic(folder + "/traj_w_c.txt", text);
  const std::vector<std::string> found = findings(even_odd(folder));
  const std::string t = folder + "/traj_w_c.txt";
  ASSERT_EQ(found.size(), 3u);
  EXPECT_EQ(found[0], t + ":3: expected 16 numbers, got 3; write one camera-to-world matrix a line, row by row");
  EXPECT_EQ(found[1],
            t + ":4: pose is not a rotation: its axes are 3 off orthonormal (1e-3 is allowed); check that the "
                "matrix is camera-to-world, row by "
                "row, without a scale");
  EXPECT_EQ(found[2], t + ": 1 of 2 frames skipped: their poses are not finite (1)");
}

TEST(SceneErrors, FoldersAndTables) {
  const std::string folder = fresh_folder("room");
  const auto open = [](const ReplicaParams& p) {
    return error_of([&] {
      Replica replica(p, {});
      Diagnostics d;
      (void)replica.open(d);
      d.throw_if_errors(ErrorKind::data, "");
    });
  };
  EXPECT_EQ(open(even_odd(folder + "/none")), "folder '" + folder + "/none' is missing; check scene.root");
  EXPECT_EQ(open(even_odd(folder)), "no traj_w_c.txt in '" + folder +
                                        "' or its Sequence_1; check scene.root; it names the folder of one scene");
  write_file_atomic(folder + "/traj_w_c.txt", std::string_view(""));
  EXPECT_EQ(open(even_odd(folder)), folder + "/traj_w_c.txt: no frames in it; check the path");
  write_replica(folder, 2);
  std::filesystem::remove(folder + "/classes.yaml");
  const std::string no_table = open(even_odd(folder));
  EXPECT_TRUE(no_table.starts_with(folder + ": labels without a class table")) << no_table;
  for (const char* said :
       {"classes.yaml", "classes.csv", "info_semantic.json", "- {id: 1, name: wall}", "--set scene.classes=FILE"})
    EXPECT_HAS(no_table, said) << said;
  ReplicaParams p = even_odd(folder);
  p.label_dir = "cnn";
  EXPECT_EQ(open(p), folder + "/cnn: label folder is missing; check scene.label_dir and scene.test_label_dir");
  Diagnostics d;
  p.test_offset = 4;
  validate(p, d);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_EQ(d.all()[0].text(),
            "test_offset: test frames 4 + n * 2 meet training frames 0 + n * 2; choose offsets that never meet, or "
            "test_step: 0");
}

std::string transforms_error(const std::string& json) {
  const std::string folder = fresh_folder("json");
  write_file_atomic(folder + "/transforms.json", json);
  write_png_rgb(folder + "/a.png", 4, 4, std::vector<std::uint8_t>(48));
  const std::string message = error_of([&] {
    TransformsJsonParams p{.root = folder};
    TransformsJson scene(p, {});
    Diagnostics d;
    (void)scene.open(d);
    d.throw_if_errors(ErrorKind::data, "");
  });
  std::string out = message;
  for (std::size_t at = out.find(folder); at != std::string::npos; at = out.find(folder))
    out.replace(at, folder.size(), "ROOT");
  return out;
}

TEST(SceneErrors, TransformsJson) {
  const std::string eye = "\"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
  const std::string frame = "{\"file_path\": \"a\", " + eye + "}";
  EXPECT_EQ(transforms_error("{\"fl_x\": 4, \"frames\": [" + frame + "]}"), "");
  EXPECT_EQ(
      transforms_error("{\"frames\": 3}"),
      "'ROOT/transforms.json' has no list 'frames'; give a transforms.json of nerfstudio, instant-ngp or Blender");
  EXPECT_EQ(transforms_error("{\"frames\": ").find("'ROOT/transforms.json' is not valid JSON: "), 0u);
  EXPECT_EQ(transforms_error("{\"camera_model\": \"FISHEYE624\", \"frames\": [" + frame + "]}")
                .find("ROOT/transforms.json: camera model 'FISHEYE624' is not supported (only OPENCV, PINHOLE, "
                      "SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV_FISHEYE, EQUIRECTANGULAR); undistort the images "
                      "to a pinhole camera, for example with colmap "
                      "image_undistorter"),
            0u);
  EXPECT_EQ(transforms_error("{\"fl_x\": 4, \"frames\": [{\"file_path\": \"a\"}]}"),
            "ROOT/transforms.json: frame 0 (a): has no 'transform_matrix'; write the "
            "camera-to-world matrix row by row");
  EXPECT_EQ(transforms_error("{\"fl_x\": 4, \"frames\": [" + frame + "," + frame + "]}"),
            "ROOT/transforms.json: frame 1 (a): image is listed twice; keep one of the two frames");
  EXPECT_EQ(transforms_error("{\"frames\": [" + frame + "]}"),
            "frame 'a' (ROOT/a.png): no focal length: neither the file nor the frame has 'fl_x', 'camera_angle_x' or a "
            "matrix 'K'; write 'fl_x', 'fl_y', 'cx' and 'cy' in pixels");
  EXPECT_EQ(transforms_error("{\"fl_x\": 4, \"w\": 8, \"h\": 4, \"frames\": [" + frame + "]}"),
            "frame 'a' (ROOT/a.png): colour image 'ROOT/a.png' is 4 x 4 pixels, the camera 8 x 4: another aspect "
            "ratio; give the images that the cameras were made from, or scaled copies");
}

}  // namespace
}  // namespace semfield
