// inspect, pack and the choice of a preset: what a user reads, and that a packed scene is the scene.
#include <cstring>

#include "app/scene/capture_replica.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "datasets/colmap/colmap.h"
#include "datasets/llff/llff.h"
#include "datasets/packed/packed.h"
#include "datasets/replica/replica.h"
#include "datasets/transforms_json/transforms_json.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

ReplicaParams room_params(const std::string& folder) {
  return ReplicaParams{.root = folder, .train_step = 2, .test_step = 2, .test_offset = 1};
}

TEST(Pack, PackedSceneIsTheScene) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  SceneLoadOptions half{.downscale = 2};
  const PackSummary summary = pack_scene(replica, folder + "/room.semfield", half, {}, d);
  EXPECT_EQ(summary.frames, 6);
  EXPECT_EQ(summary.bytes, std::filesystem::file_size(folder + "/room.semfield"));
  Packed packed(PackedParams{"room.semfield"}, DatasetBuild{folder});
  SceneLoadOptions whole{.with_instances = half.with_instances = true};
  const LoadedScene a = load_scene(replica, half, d), b = load_scene(packed, whole, d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(b.frames.size(), 6u);
  EXPECT_EQ(a.bounds.hi, b.bounds.hi);
  EXPECT_EQ(a.far_m, b.far_m);
  EXPECT_EQ(a.class_pixels, b.class_pixels);
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_EQ(a.frames[i].rgb, b.frames[i].rgb);
    EXPECT_EQ(a.frames[i].depth_m, b.frames[i].depth_m);
    EXPECT_EQ(a.frames[i].label, b.frames[i].label);
    EXPECT_EQ(a.frames[i].instance, b.frames[i].instance);
    EXPECT_EQ(a.info.frames[i].split, b.info.frames[i].split);
    EXPECT_EQ(a.info.frames[i].camera.fx, b.info.frames[i].camera.fx);
  }
}

TEST(Pack, MasksAndWideLensesStayAndWhatAMaskHidesDoesNot) {
  const std::string folder = fresh_folder("room");
  write_png_rgb(folder + "/a.png", 4, 2, std::vector<std::uint8_t>(24, 9));
  write_png_rgb(folder + "/b.png", 4, 2, std::vector<std::uint8_t>(24, 9));
  write_png_gray8(folder + "/m.png", 4, 2, std::vector<std::uint8_t>{255, 255, 255, 0, 255, 255, 255, 255});
  const std::string eye = "\"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}";
  write_file_atomic(
      folder + "/transforms.json",
      "{\"camera_model\": \"OPENCV_FISHEYE\", \"fl_x\": 3, \"k4\": 0.01, \"frames\": [{\"file_path\": \"a.png\", "
      "\"mask_path\": \"m.png\", " +
          eye + ", {\"file_path\": \"b.png\", " + eye + "]}");
  TransformsJson scene(TransformsJsonParams{.root = folder}, {});
  Diagnostics d;
  (void)pack_scene(scene, folder + "/room.semfield", {}, {}, d);
  ASSERT_FALSE(d.has_errors()) << d.all()[0].text();
  Packed packed(PackedParams{"room.semfield"}, DatasetBuild{folder});
  const SceneInfo info = packed.open(d);
  EXPECT_EQ(info.frames[0].camera.lens, LensKind::fisheye);
  EXPECT_EQ(info.frames[0].camera.k4, 0.01);
  FrameBuffer out;
  packed.read(0, out);
  EXPECT_EQ(out.used, (std::vector<std::uint8_t>{1, 1, 1, 0, 1, 1, 1, 1}));
  EXPECT_EQ(out.rgb[9], 0);
  EXPECT_EQ(out.rgb[8], 9);
  packed.read(1, out);
  EXPECT_TRUE(out.used.empty());
}

TEST(Pack, WhatIsPackedIsMended) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  SceneLoadOptions options{.convention = {true, true, 0.5, 2}};
  (void)pack_scene(replica, folder + "/room.semfield", options, {}, d);
  Packed packed(PackedParams{"room.semfield"}, DatasetBuild{folder});
  options.check_geometry = false;
  const LoadedScene a = load_scene(replica, options, d);
  SceneLoadOptions plain{.check_geometry = false};
  const LoadedScene b = load_scene(packed, plain, d);
  EXPECT_FALSE(d.has_errors());
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_EQ(a.info.frames[i].world_from_camera.r, b.info.frames[i].world_from_camera.r);
    EXPECT_EQ(a.info.frames[i].world_from_camera.t, b.info.frames[i].world_from_camera.t);
    EXPECT_EQ(a.frames[i].depth_m, b.frames[i].depth_m);
  }
  EXPECT_EQ(a.bounds.lo, b.bounds.lo);
  EXPECT_EQ(a.far_m, b.far_m);
}

TEST(Inspect, TellsHowMuchIsMasked) {
  LoadedScene scene;
  FrameBuffer frame{.width_px = 4, .height_px = 2};
  frame.rgb.assign(24, 9);
  for (const char* name : {"a", "b"}) {
    scene.info.frames.push_back({.name = name});
    scene.frames.emplace_back(frame);
    scene.class_pixels.emplace_back();
    frame.used = {1, 1, 0, 1, 1, 0, 1, 1};
  }
  EXPECT_HAS(inspect_report(scene, {}), "masked      1 of 2 frames, 25.0 % of their pixels, most in 'b' (25.0 %)");
  EXPECT_EQ(inspect_json(scene, {}, "")["masked"].dump(), "{\"b\":0.25}");
}

TEST(Inspect, NamesThePresetThatSuitsTheCameras) {
  LoadedScene scene;
  const auto says = [&](const std::string& text) { return inspect_report(scene, {}).find(text) != std::string::npos; };
  EXPECT_FALSE(says("preset"));  // nothing was loaded
  scene.bounds = {{-1, -1, -1}, {1, 1, 1}};
  EXPECT_TRUE(says("preset      presets/room.yaml:"));
  scene.rig.inward = true;
  EXPECT_TRUE(says("preset      presets/unbounded.yaml:"));
  scene.plain_background = PlainBackground{{255, 255, 255}, scene.bounds};
  EXPECT_TRUE(
      says("preset      presets/object.yaml: the cameras stand around an object before one colour, (255, 255, 255)"));
  scene.plain_background->color = {0, 51, 255};
  EXPECT_TRUE(says("preset      presets/object.yaml with rendering.background: [0, 0.2, 1]:"));
  scene.info.frames.resize(1);
  scene.frames.resize(1);
  scene.class_pixels.resize(1);
  scene.info.frames[0].has_depth = true;
  scene.plain_background.reset();
  EXPECT_TRUE(says("preset      presets/room.yaml: depth images show where the scene ends"));
  const app::Json json = inspect_json(scene, {});
  EXPECT_EQ(json.at("preset"), "presets/room.yaml");
  EXPECT_EQ(json.at("preset_why"), "depth images show where the scene ends");
}

TEST(Inspect, ReportTellsFramesClassesAndProblems) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  cut(folder + "/rgb/rgb_3.png", 20);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  const LoadedScene scene = load_scene(replica, {}, d);
  const std::string report = inspect_report(scene, d);
  EXPECT_HAS(
      report, "frames      6 (3 train, 3 test), 5 read, 6 with depth\n", "size        40 x 30 (6 frames)\n",
      "bounds      (", " from depth of 3 training frames\n", "near, far   0.1, 10 from the dataset\n",
      "labelled frames: 3 train, 2 test", "north", "3 of 3",
      "error       frame 'rgb_3' (" + folder + "/rgb/rgb_3.png): '" + folder + "/rgb/rgb_3.png': PNG is truncated");
}

TEST(Inspect, FrustaFileHasTheStatedSize) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 4);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  const LoadedScene scene = load_scene(replica, {}, d);
  write_frusta_ply(folder + "/cameras.ply", scene);
  const std::string file = read_text_file(folder + "/cameras.ply");
  const std::size_t body = file.find("end_header\n") + 11;
  EXPECT_HAS(file, "element vertex 20\n");
  EXPECT_EQ(file.size() - body, 20u * 27 + 4u * (4 * 13 + 17));
}

// The layout has whole millimetres: depth of less is lost, and counted.
TEST(Capture, DepthThatMillimetresDoNotHoldIsCounted) {
  const std::string folder = fresh_folder("c");
  write_png_rgb(folder + "/a.png", 4, 2, std::vector<std::uint8_t>(24, 9));
  write_png_gray16(folder + "/d.png", 4, 2, std::vector<std::uint16_t>{0, 1, 4, 5, 10, 20, 30, 65000});
  write_file_atomic(folder + "/transforms.json",
                    std::string_view("{\"fl_x\": 3, \"depth_unit_m\": 0.0001, \"frames\": [{\"file_path\": "
                                     "\"a.png\", \"depth_path\": \"d.png\", \"transform_matrix\": "
                                     "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}"));
  TransformsJson scene(TransformsJsonParams{.root = folder}, {});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  ASSERT_FALSE(d.has_errors()) << d.all()[0].text();
  EXPECT_EQ(capture_replica(scene, info, folder + "/out").depth_clipped, 2) << "a tenth and four tenths";
  EXPECT_EQ(read_ids(folder + "/out/depth/depth_0.png").pixels,
            (std::vector<std::uint16_t>{0, 0, 0, 1, 1, 2, 3, 6500}));
}

// Two cameras a thousandth apart, ten million away from 0, and nothing else that tells a size.
TEST(Inspect, FrustaSuitTheDistanceAndThePlaceOfTheCameras) {
  LoadedScene scene;
  for (const double x : {1e7, 1e7 + 1e-3}) {
    FrameInfo frame{.name = "f"};
    frame.camera = room_camera();
    frame.world_from_camera.t = {x, 0, 0};
    scene.info.frames.push_back(frame);
  }
  scene.frames.resize(2);
  scene.class_pixels.resize(2);
  const std::string path = fresh_folder("f") + "/cameras.ply";
  write_frusta_ply(path, scene);
  const std::string file = read_text_file(path);
  const auto number = [&](std::size_t vertex, std::size_t axis) {
    double out = 0;
    std::memcpy(&out, file.data() + file.find("end_header\n") + 11 + 27 * vertex + 8 * axis, sizeof out);
    return out;
  };
  EXPECT_NEAR(number(5, 0) - number(0, 0), 1e-3, 1e-8) << "centres";
  EXPECT_NEAR(number(1, 2), 2e-5, 1e-9) << "a fiftieth of their distance";
}

// The preset that `semfield inspect` advises is the one that trained best: docs/evidence/scenes.md has the figures.

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

template <class Reader, class Params>
std::function<std::unique_ptr<Dataset>(const std::string&)> reads() {
  return [](const std::string& root) -> std::unique_ptr<Dataset> {
    Params params;
    params.root = root;
    return std::make_unique<Reader>(params, DatasetBuild{});
  };
}
const auto kTransforms = reads<TransformsJson, TransformsJsonParams>();

struct Measured {
  const char *name, *folder, *preset;
  std::function<std::unique_ptr<Dataset>(const std::string&)> reader;
  int width_px;
};
void PrintTo(const Measured& m, std::ostream* out) { *out << m.name; }

class PresetAdviceOf : public testing::TestWithParam<Measured> {};

TEST_P(PresetAdviceOf, IsWhatTrainedBest) {
  const Measured& scene = GetParam();
  if (!std::filesystem::exists(data(scene.folder)))
    GTEST_SKIP() << "the optional scene " << scene.folder << " is not at hand";
  SceneLoadOptions options{.width_px = scene.width_px, .depth = DepthKept::none};
  Diagnostics d;
  const LoadedScene loaded = load_scene(*scene.reader(data(scene.folder)), options, d);
  EXPECT_FALSE(d.has_errors());
  const std::optional<PresetAdvice> advice = advised_preset(loaded);
  ASSERT_TRUE(advice);
  EXPECT_EQ(advice->preset, std::string("presets/") + scene.preset) << advice->why;
  EXPECT_FALSE(advice->background) << "white is the preset's own";
}

INSTANTIATE_TEST_SUITE_P(
    RealScenes, PresetAdviceOf,
    testing::Values(Measured{"bonsai", "bonsai360", "room.yaml", kTransforms, 400},
                    Measured{"bonsai_llff", "bonsai360", "room.yaml", reads<Llff, LlffParams>(), 400},
                    Measured{"llff_room", "llff_room", "room.yaml", kTransforms, 400},
                    Measured{"studio", "studio_room", "room.yaml", kTransforms, 480},
                    Measured{"studio_colmap", "studio_room", "room.yaml", reads<Colmap, ColmapParams>(), 480},
                    Measured{"hololens", "hololens_room", "room.yaml", kTransforms, 180},
                    Measured{"shelf", "shelf_bin", "room.yaml", kTransforms, 160},
                    Measured{"lego", "lego", "object.yaml", kTransforms, 200},
                    Measured{"replica", "replica_apartment0", "room.yaml", reads<Replica, ReplicaParams>(), 160}),
    [](const auto& row) { return row.param.name; });

// Forward-facing photographs: the box of what is seen and not that of the view cones.
TEST(SceneBounds, CornersTellWhereAForwardFacingRoomIs) {
  if (!std::filesystem::exists(data("llff_room"))) GTEST_SKIP() << "the optional scene llff_room is not at hand";
  SceneLoadOptions options{.width_px = 400};
  Diagnostics d;
  const LoadedScene scene = load_scene(*kTransforms(data("llff_room")), options, d);
  EXPECT_HAS(scene.bounds_from, "corners found again");
  EXPECT_GT(scene.near_m, 3);  // LLFF's own figures are 8.9 to 47
  EXPECT_LT(scene.near_m, 14);
  EXPECT_GT(scene.far_m, 45);
  EXPECT_LT(scene.far_m, 70);
}

LoadedScene inward_scene(double reach, std::size_t corners) {
  LoadedScene scene{.bounds = {{-1, -1, -1}, {1, 1, 1}}, .rig = {.inward = true, .distance_m = 2}};
  for (std::size_t i = 0; i < corners; ++i) {
    const double away = i % 3 == 0 ? 2 * reach : 1;
    scene.corners.x.push_back(static_cast<float>(away));
    scene.corners.y.push_back(0);
    scene.corners.z.push_back(0);
    scene.corners.distance.push_back(1);
  }
  return scene;
}

TEST(PresetAdvice, SurroundingsThatEndAreARoom) {
  EXPECT_EQ(advised_preset(inward_scene(3, 600))->preset, "presets/room.yaml");
  EXPECT_EQ(advised_preset(inward_scene(20, 600))->preset, "presets/unbounded.yaml");
  EXPECT_EQ(advised_preset(inward_scene(3, 20))->preset, "presets/unbounded.yaml") << "too few corners to say";
}

}  // namespace
}  // namespace semfield
