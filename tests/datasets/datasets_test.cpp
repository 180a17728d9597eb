// Broken scenes and the exact sentences that they get: place, cause, remedy.

#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "core/files.h"
#include "formats/image_io.h"
#include "scene/scene.h"
#include "tests/datasets/named_dataset.h"
#include "tests/datasets/rewritten_poses.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace app;
using namespace testing_room;

// Alpha of transparent images: offered, read where it is wanted, scaled with the colours, packed, and refused where it
// is none.

constexpr std::int32_t kSide = 4;

// Frame a: red, alpha 16 times the pixel's number; frame b: the same without alpha.
std::string two_images(const std::string& name) {
  const std::string folder = fresh_folder(name);
  std::vector<std::uint8_t> with, without;
  for (std::uint8_t i = 0; i < kSide * kSide; ++i) {
    with.insert(with.end(), {200, 0, 0, static_cast<std::uint8_t>(16 * i)});
    without.insert(without.end(), {200, 0, 0});
  }
  const auto write = [&](const char* file, int color_type, const std::vector<std::uint8_t>& rows) {
    const std::vector<std::uint8_t> png = encode_png(kSide, kSide, color_type, 8, rows);
    write_file_atomic(folder + file, std::as_bytes(std::span(png)));
  };
  write("/a.png", 6, with);
  write("/b.png", 2, without);
  const std::string pose = R"("transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]])";
  write_file_atomic(folder + "/transforms.json", R"({"fl_x": 4, "frames": [{"file_path": "a.png", )" + pose +
                                                     R"(}, {"file_path": "b.png", )" + pose + "}]}");
  return folder;
}

SceneLoadOptions load(double downscale, bool wanted) {
  SceneLoadOptions options{.downscale = downscale, .near_m = 1, .far_m = 2, .bounds = {-1, -1, -1, 1, 1, 1}};
  options.check_geometry = false;
  if (wanted) options.channels = {std::string(kAlphaChannel)};
  return options;
}

TEST(Alpha, IsReadWhereItIsWantedAndScaledWithTheColours) {
  NamedDataset scene("transforms_json", {{"root", two_images("s")}, {"test_every", "0"}});
  Diagnostics d;
  const LoadedScene plain = load_scene(scene, load(1, false), d), whole = load_scene(scene, load(1, true), d),
                    half = load_scene(scene, load(2, true), d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(plain.frames.size(), 2U);
  EXPECT_TRUE(plain.frames[0].alpha.empty());
  ASSERT_EQ(whole.frames[0].alpha.size(), 16U);
  for (std::size_t i = 0; i < 16; ++i) EXPECT_EQ(whole.frames[0].alpha[i], 16 * i);
  EXPECT_TRUE(whole.frames[0].channels.empty()) << "kept in bytes alone";
  EXPECT_EQ(whole.frames[0].bytes(), plain.frames[0].bytes() + 16);
  EXPECT_EQ(half.frames[0].alpha, (std::vector<std::uint8_t>{40, 72, 168, 200})) << "means of four";
  EXPECT_TRUE(whole.frames[1].alpha.empty()) << "an image without";
}

TEST(Alpha, IsNotOfferedWhereItIsDropped) {
  NamedDataset scene("transforms_json", {{"root", two_images("s")}, {"test_every", "0"}, {"alpha_background", "-1"}});
  Diagnostics d;
  EXPECT_TRUE(scene.open(d).frames.at(0).channels.empty());
}

TEST(Alpha, APackedSceneHasIt) {
  const std::string folder = two_images("s");
  NamedDataset scene("transforms_json", {{"root", folder}, {"test_every", "0"}});
  Diagnostics d;
  (void)pack_scene(scene, folder + "/packed", load(2, false), d);
  NamedDataset packed("packed", {{"file", "packed"}}, DatasetBuild{folder});
  const LoadedScene a = load_scene(scene, load(2, true), d), b = load_scene(packed, load(1, true), d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(a.frames[0].alpha, b.frames[0].alpha);
  EXPECT_FALSE(b.frames[0].alpha.empty());
  EXPECT_TRUE(b.frames[1].alpha.empty());
  EXPECT_TRUE(load_scene(packed, load(1, false), d).frames[0].alpha.empty());
  EXPECT_EQ(read_text_file(folder + "/packed").at(8), 2) << "a build that knows no alpha says so by the version";
}

TEST(Alpha, IsAShareOfEachPixelOfTheImage) {
  FrameChannelInfo told{std::string(kAlphaChannel), kSide, kSide, 1};
  std::vector<float> values(kSide * kSide, 0.5F);
  const auto refusal = [&] {
    NamedDataset images("transforms_json", {{"root", two_images("s")}, {"test_every", "0"}});
    Diagnostics d;
    const SceneReader reader{[&](Diagnostics& found) {
                               SceneInfo info = images.open(found);
                               for (FrameInfo& frame : info.frames) frame.channels = {told};
                               return info;
                             },
                             [&](int frame, FrameBuffer& out) {
                               out.wanted.clear();
                               images.read(frame, out);
                               out.channels.push_back({told.name, told.height, told.width, told.cols, values});
                             }};
    (void)load_scene(reader, load(1, true), d);
    return d;
  };
  EXPECT_FALSE(refusal().has_errors());
  values[6] = 1.5F;
  EXPECT_FINDING(refusal(), "scene.alpha.range", "1.5", "x 2, y 1", "frame 'a'");
  told.width = 2;
  values.assign(kSide * 2, 0.5F);
  EXPECT_FINDING(refusal(), "scene.alpha.size", "2 x 4", "4 x 4");
}

// A scene whose cameras were fixed, written and read again.

struct Source {
  PosedScene scene;
  FixedCameras fixed;

  Source() {
    SceneInfo& info = scene.info;
    info.name = "source";
    info.classes = ClassTable(std::vector<ClassEntry>{{7, "wall", {1, 2, 3}, false}, {300, "lamp", {4, 5, 6}, false}});
    for (int i = 0; i < 4; ++i) {
      FrameInfo f{.name = "a/" + std::to_string(i),
                  .source = "none",
                  .camera = room_camera(16, 12),
                  .world_from_camera = room_pose(i)};
      f.split = i == 1 ? Split::test : i == 3 ? Split::unused : Split::train;
      f.has_depth = f.has_labels = f.has_instances = true;
      info.frames.push_back(f);
      fixed.cameras.push_back(f.camera);
      fixed.cameras.back().fx *= 1.1;
      fixed.cameras.back().k1 = i == 2 ? 0 : -0.01;
      fixed.poses.push_back(room_pose(i + 1));
    }
    scene.read = [](int frame, FrameBuffer& out) {
      out.width_px = 16;
      out.height_px = 12;
      for (int p = 0; p < 16 * 12; ++p) {
        for (int c = 0; c < 3; ++c) out.rgb.push_back(static_cast<std::uint8_t>(p + c));
        out.depth_m.push_back(p == 5 ? 0.0f : 2.0f + 0.001f * static_cast<float>(p + frame));
        out.label.push_back(p == 7 ? kVoid : static_cast<std::int16_t>(p % 2));
        out.instance.push_back(p);
        out.used.push_back(p == 9 ? 0 : 1);
      }
    };
  }
  void write(const std::string& folder) const {
    app::write_fixed_scene(scene, fixed, folder, [](const CaptureStep&, double, double) {});
  }
};

TEST(FixedScene, HasTheNewCamerasAndEverythingElseAsItWas) {
  const Source source;
  const std::string folder = fresh_folder("fixed");
  source.write(folder);
  NamedDataset again("transforms_json", {{"root", folder}});
  Diagnostics d;
  const SceneInfo info = again.open(d);
  for (const Diagnostic& one : d.all()) EXPECT_EQ(one.severity, Severity::note) << one.text();
  ASSERT_EQ(info.frames.size(), 3u) << "the unused one is in neither list";
  EXPECT_EQ(info.frames[0].name, "0");
  EXPECT_TRUE(info.frames[1].split == Split::test && info.frames[2].split == Split::train);
  for (std::size_t i = 0; i < 3; ++i) {
    const Camera &found = info.frames[i].camera, &wanted = source.fixed.cameras[i];
    EXPECT_TRUE(found == wanted) << i << ": " << found.fx << " " << found.k1;
    EXPECT_LT(length(info.frames[i].world_from_camera.t - source.fixed.poses[i].t), 1e-12);
    EXPECT_LT(length(info.frames[i].world_from_camera.axis(2) - source.fixed.poses[i].axis(2)), 1e-12);
    FrameBuffer was, is;
    source.scene.read(static_cast<int>(i), was);
    again.read(static_cast<int>(i), is);
    EXPECT_EQ(is.rgb, was.rgb);
    EXPECT_EQ(is.label, was.label);
    EXPECT_EQ(is.instance, was.instance);
    EXPECT_EQ(is.used, was.used);
    ASSERT_EQ(is.depth_m.size(), was.depth_m.size());
    for (std::size_t p = 0; p < was.depth_m.size(); ++p) EXPECT_NEAR(is.depth_m[p], was.depth_m[p], 6e-5) << p;
  }
}

// Depth would say it by itself.
TEST(FixedScene, WithoutDepthItsUnitIsStated) {
  for (const bool metric : {true, false}) {
    Source source;
    source.scene.info.metric = metric;
    for (FrameInfo& frame : source.scene.info.frames) frame.has_depth = false;
    const std::string folder = fresh_folder("metric");
    source.write(folder);
    NamedDataset again("transforms_json", {{"root", folder}});
    Diagnostics d;
    EXPECT_EQ(again.open(d).metric, metric);
  }
}

// One camera that took all depth stands in the file; of several, depth is drawn into the colour images.
TEST(FixedScene, DepthOfACameraOfItsOwn) {
  Source source;
  source.fixed.depth_apart = true;
  source.fixed.depth_from_color.t = {0, 0, 0.5};
  source.fixed.depth_cameras.assign(4, source.scene.info.frames[0].camera);
  const auto middle = [](const std::string& folder) {
    NamedDataset again("transforms_json", {{"root", folder}});
    Diagnostics d;
    (void)again.open(d);
    FrameBuffer out;
    again.read(0, out);
    return out.depth_m[6 * 16 + 8];
  };
  const std::string one = fresh_folder("one"), several = fresh_folder("several");
  source.write(one);
  EXPECT_HAS(read_text_file(one + "/transforms.json"), "\"depth_camera\"");
  EXPECT_NEAR(middle(one), 1.6f, 0.02f);
  source.fixed.depth_cameras[3].fx += 1;
  source.write(several);
  EXPECT_EQ(read_text_file(several + "/transforms.json").find("depth_camera"), std::string::npos);
  EXPECT_NEAR(middle(several), 1.6f, 0.02f);
}

// The choice of a preset. That a packed scene is the scene: tests/bad_files/scenes.cases.

NamedDataset replica_of(const std::string& folder) {
  return NamedDataset("replica", {{"root", folder}, {"train_step", "2"}, {"test_step", "2"}, {"test_offset", "1"}});
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

// The layout has whole millimetres: depth of less is lost.
TEST(Capture, DepthIsInWholeMillimetres) {
  const std::string folder = fresh_folder("c");
  write_png_rgb(folder + "/a.png", 4, 2, std::vector<std::uint8_t>(24, 9));
  write_png_gray16(folder + "/d.png", 4, 2, std::vector<std::uint16_t>{0, 1, 4, 5, 10, 20, 30, 65000});
  write_file_atomic(folder + "/transforms.json",
                    std::string_view("{\"fl_x\": 3, \"depth_unit_m\": 0.0001, \"frames\": [{\"file_path\": "
                                     "\"a.png\", \"depth_path\": \"d.png\", \"transform_matrix\": "
                                     "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}"));
  NamedDataset scene("transforms_json", {{"root", folder}});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  ASSERT_FALSE(d.has_errors()) << d.all()[0].text();
  (void)capture_replica(scene, info, folder + "/out");
  EXPECT_EQ(read_ids(folder + "/out/depth/depth_0.png").pixels,
            (std::vector<std::uint16_t>{0, 0, 0, 1, 1, 2, 3, 6500}));
}

// The preset that `semfield inspect` advises is the one that trained best: docs/evidence/scenes.md has the figures.

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

struct Measured {
  const char *name, *folder, *preset, *reader;
  int width_px;
};
void PrintTo(const Measured& m, std::ostream* out) { *out << m.name; }

class PresetAdviceOf : public testing::TestWithParam<Measured> {};

TEST_P(PresetAdviceOf, IsWhatTrainedBest) {
  const Measured& scene = GetParam();
  if (!fs::exists(data(scene.folder))) GTEST_SKIP() << "the optional scene " << scene.folder << " is not at hand";
  SceneLoadOptions options{.width_px = scene.width_px, .depth = DepthKept::none};
  Diagnostics d;
  NamedDataset dataset(scene.reader, {{"root", data(scene.folder)}});
  const LoadedScene loaded = load_scene(dataset, options, d);
  EXPECT_FALSE(d.has_errors());
  const std::optional<PresetAdvice> advice = advised_preset(loaded);
  ASSERT_TRUE(advice);
  EXPECT_EQ(advice->preset, std::string("presets/") + scene.preset) << advice->why;
  EXPECT_FALSE(advice->background) << "white is the preset's own";
}

INSTANTIATE_TEST_SUITE_P(RealScenes, PresetAdviceOf,
                         testing::Values(Measured{"bonsai", "bonsai360", "unbounded.yaml", "transforms_json", 400},
                                         Measured{"bonsai_llff", "bonsai360", "unbounded.yaml", "llff", 400},
                                         Measured{"garden", "garden", "unbounded.yaml", "transforms_json", 256},
                                         Measured{"fern", "fern", "room.yaml", "llff", 400},
                                         Measured{"studio", "studio_room", "room.yaml", "transforms_json", 480},
                                         Measured{"studio_colmap", "studio_room", "room.yaml", "colmap", 480},
                                         Measured{"hololens", "hololens_room", "room.yaml", "transforms_json", 180},
                                         Measured{"shelf", "shelf_bin", "room.yaml", "transforms_json", 160},
                                         Measured{"lego", "lego", "object.yaml", "transforms_json", 200},
                                         Measured{"replica", "replica_apartment0", "room.yaml", "replica", 160}),
                         [](const auto& row) { return row.param.name; });

// Forward-facing photographs: the box of what is seen and not that of the view cones.
TEST(SceneBounds, CornersTellWhereAForwardFacingSceneIs) {
  if (!fs::exists(data("fern"))) GTEST_SKIP() << "the optional scene fern is not at hand";
  SceneLoadOptions options{.width_px = 400};
  Diagnostics d;
  NamedDataset llff("llff", {{"root", data("fern")}});
  const LoadedScene scene = load_scene(llff, options, d);
  EXPECT_HAS(scene.bounds_from, "corners found again");
  EXPECT_GT(scene.near_m, 5);  // LLFF's own figures are 17 to 80
  EXPECT_LT(scene.near_m, 17);
  EXPECT_GT(scene.far_m, 70);
  EXPECT_LT(scene.far_m, 110);
}

// What is guessed of photographs without depth: cameras, and the places of corners that were found again.
struct Guessed {
  LoadedScene scene;
  PresetAdvice advice;
};
Guessed guessed(std::vector<FrameInfo> frames, const std::vector<Vec3d>& corners, bool before_white = false,
                const SceneLoadOptions& options = {}) {
  Guessed out;
  out.scene.class_pixels.resize(frames.size());
  for (std::size_t f = 0; f < frames.size(); ++f) {
    FrameBuffer pixels{.width_px = 48, .height_px = 48};
    for (int i = 0; i < 48 * 48; ++i) {
      const bool ball = std::hypot(i % 48 - 23.5, i / 48 - 23.5) < 10;
      const int grey = before_white ? (ball ? 90 : 255) : (i * 37 + i / 48 * 91) % 256;
      pixels.rgb.insert(pixels.rgb.end(), 3, static_cast<std::uint8_t>(grey));
    }
    out.scene.frames.emplace_back(std::move(pixels));
  }
  for (std::size_t i = 0; i < corners.size(); ++i)
    out.scene.corners.add(corners[i], length(corners[i] - frames[i % frames.size()].world_from_camera.t));
  out.scene.info.frames = std::move(frames);
  Diagnostics d;
  derive_extent(out.scene, {}, options, d);
  for (const Diagnostic& x : d.all()) ADD_FAILURE() << x.text();
  out.advice = advised_preset(out.scene).value();
  return out;
}

bool holds(const Box& box, Vec3d p) { return box.lo.x <= p.x && p.x <= box.hi.x && box.lo.z <= p.z && p.z <= box.hi.z; }

// `away` from the axis y, at `count` places.
std::vector<Vec3d> ring(int count, double away, double height) {
  std::vector<Vec3d> out;
  for (int i = 0; i < count; ++i)
    out.push_back({away * std::cos(2.4 * i), height * std::sin(i), away * std::sin(2.4 * i)});
  return out;
}

// Around a table, with corners on it and on what is `away`, in front of all.
Guessed around_a_table(double away, std::size_t corners) {
  std::vector<FrameInfo> frames;
  for (const Vec3d eye : ring(24, 2, 0.2)) frames.push_back(frame_at(eye + Vec3d{0, 0.8, 0}, {}));
  std::vector<Vec3d> places = ring(200, away, 1), table = ring(400, 0.4, 0.3);
  places.insert(places.end(), table.begin(), table.end());
  places.resize(corners);
  return guessed(std::move(frames), places);
}

TEST(Guess, OutdoorsGoesOnBehindItsSubject) {
  const Guessed garden = around_a_table(6, 600), room = around_a_table(3, 600);
  EXPECT_EQ(garden.advice.preset, "presets/unbounded.yaml");
  EXPECT_HAS(garden.advice.why, "the cameras stand around one place and see what lies behind it, beyond");
  EXPECT_TRUE(holds(garden.scene.bounds, {6, 0, 0}));
  EXPECT_EQ(room.advice.preset, "presets/room.yaml");
  EXPECT_HAS(room.advice.why, "times their distance, as in a room");
  EXPECT_FALSE(holds(room.scene.bounds, {6, 0, 0}));
}

TEST(Guess, ForwardFacingViewsAreARoomSeenFromOneSide) {
  std::vector<FrameInfo> frames;
  std::vector<Vec3d> leaves;
  for (int i = 0; i < 20; ++i) frames.push_back(frame_at({0.2 * i - 2, 0.3 * (i % 4), 0.05 * (i % 3)}, {0, 0, 30}));
  for (int i = 0; i < 600; ++i) leaves.push_back({4 * std::sin(2.4 * i), 3 * std::cos(i), i % 20 == 0 ? 16.0 : 5});
  const Guessed fern = guessed(frames, leaves);
  EXPECT_EQ(fern.advice.text(), "presets/room.yaml: forward-facing: 20 views from one side");
  EXPECT_HAS(inspect_report(fern.scene, {}), "views       forward-facing: 20 views from one side; render, and look at");
  EXPECT_EQ(inspect_json(fern.scene, {})["forward_facing"], true);
  EXPECT_HAS(fern.scene.bounds_from, "600 corners found again");
  for (const double far : {5.0, 16.0}) EXPECT_TRUE(holds(fern.scene.bounds, {3.5, 0, far}));
  EXPECT_LT(fern.scene.bounds.hi.z, 25);
  EXPECT_GT(fern.scene.bounds.lo.z, -2) << "nothing is seen behind the cameras";
  // Contracted: cells are even as far as the leaves, and not about the cameras alone.
  const Guessed contracted = guessed(frames, leaves, false, {.contracted = true});
  EXPECT_HAS(contracted.scene.bounds_from, "where the cameras stand, up to the nearest corners seen");
  EXPECT_NEAR(contracted.scene.bounds.hi.z, 5, 0.5);
}

TEST(Guess, ARoomFromInsideAndAnObjectBeforeOneColour) {
  std::vector<FrameInfo> outward, inward;
  for (const Vec3d eye : ring(24, 0.5, 0.1)) outward.push_back(frame_at(eye, eye * 6));
  for (const Vec3d eye : ring(40, 3, 2)) inward.push_back(frame_at(eye, {}));
  const Guessed room = guessed(std::move(outward), ring(600, 3, 1.2)), ball = guessed(std::move(inward), {}, true);
  EXPECT_EQ(room.advice.text(), "presets/room.yaml: the cameras do not stand around one place");
  EXPECT_EQ(inspect_report(room.scene, {}).find("views"), std::string::npos);
  EXPECT_TRUE(holds(room.scene.bounds, {-2.9, 0, 0}));
  EXPECT_EQ(ball.advice.preset, "presets/object.yaml");
  EXPECT_HAS(ball.scene.bounds_from, "the object's silhouettes");
  for (const Guessed* one : {&room, &ball}) EXPECT_FALSE(holds(one->scene.bounds, {-5, 0, 0}));
}

// The datasets on real scenes, where they are at hand.

TEST(RealData, ReplicaApartment) {
  if (!fs::exists(data("replica_apartment0"))) GTEST_SKIP() << "the optional Replica frames are not at hand";
  NamedDataset replica = replica_of(data("replica_apartment0"));
  Diagnostics d;
  SceneLoadOptions o{.width_px = 160};
  const LoadedScene s = load_scene(replica, o, d);
  for (const Diagnostic& x : d.all()) EXPECT_EQ(x.severity, Severity::note) << x.text();
  EXPECT_EQ(s.frames_of(Split::train).size(), 35u);
  EXPECT_EQ(s.frames_of(Split::test).size(), 35u);
  EXPECT_NEAR(s.info.frames[0].camera.fx, 80.0, 1e-9);
  EXPECT_NEAR(s.info.frames[0].camera.cx, 80.0, 1e-9);  // 159.5 with integer centres
  EXPECT_FALSE(s.bounds.empty());
  EXPECT_LT(length(s.bounds.size()), 40.0);
}

// The two exports of one reconstruction agree up to a similarity: x' = s Q x + t.
TEST(RealData, StudioRoomByColmapAndByTransforms) {
  if (!fs::exists(data("studio_room"))) GTEST_SKIP() << "the optional studio photographs are not at hand";
  NamedDataset by_json("transforms_json", {{"root", data("studio_room")}});
  NamedDataset by_colmap("colmap", {{"root", data("studio_room")}});
  Diagnostics d;
  const SceneInfo json = by_json.open(d), colmap = by_colmap.open(d);
  for (const Diagnostic& x : d.all()) EXPECT_EQ(x.severity, Severity::note) << x.text();
  ASSERT_EQ(colmap.frames.size(), 35u);
  ASSERT_EQ(json.frames.size(), 35u);
  EXPECT_EQ(json.frames[0].name, "0017");
  EXPECT_FALSE(json.metric);
  EXPECT_NEAR(json.frames[0].world_from_camera.axis(2).x, -0.8959027551102706, 1e-9);
  FrameBuffer pixels;
  by_json.read(0, pixels);
  EXPECT_EQ(pixels.rgb.size(), 960u * 540 * 3);
  std::map<std::string, const FrameInfo*> other;
  for (const FrameInfo& f : json.frames) other[f.name] = &f;
  const FrameInfo &a = colmap.frames[0], &b = *other.at(a.name);
  const Vec3d a_far = colmap.frames[20].world_from_camera.t - a.world_from_camera.t;
  const double scale =
      length(other.at(colmap.frames[20].name)->world_from_camera.t - b.world_from_camera.t) / length(a_far);
  const auto turned = [&](Vec3d v) { return b.world_from_camera.rotate(a.world_from_camera.unrotate(v)); };  // Q
  for (const FrameInfo& f : colmap.frames) {
    const FrameInfo& g = *other.at(f.name);
    EXPECT_EQ(f.split, g.split) << f.name;
    for (int axis = 0; axis < 3; ++axis)
      EXPECT_LT(length(turned(f.world_from_camera.axis(axis)) - g.world_from_camera.axis(axis)), 1e-6) << f.name;
    const Vec3d moved = turned(f.world_from_camera.t - a.world_from_camera.t) * scale + b.world_from_camera.t;
    EXPECT_LT(length(moved - g.world_from_camera.t), 1e-6) << f.name;
    // The model is of images twice as large.
    EXPECT_EQ(f.camera.width_px, 960);
    EXPECT_NEAR(f.camera.fx, g.camera.fx, 1e-9);
    EXPECT_NEAR(f.camera.fy, g.camera.fy, 1e-9);
    EXPECT_NEAR(f.camera.cx, g.camera.cx, 1e-9);
    EXPECT_NEAR(f.camera.cy, g.camera.cy, 1e-9);
    EXPECT_EQ(f.camera.k2, g.camera.k2);
    EXPECT_EQ(f.camera.p1, g.camera.p1);
  }
  EXPECT_FALSE(colmap.bounds.empty());
}

TEST(RealData, LlffAndTransformsOfOneSceneAgree) {
  if (!fs::exists(data("bonsai360"))) GTEST_SKIP() << "the optional scene bonsai360 is not at hand";
  NamedDataset by_json("transforms_json", {{"root", data("bonsai360")}});
  NamedDataset by_llff("llff", {{"root", data("bonsai360")}});
  Diagnostics d;
  const SceneInfo json = by_json.open(d), llff = by_llff.open(d);
  for (const Diagnostic& x : d.all()) EXPECT_EQ(x.severity, Severity::note) << x.text();
  ASSERT_EQ(json.frames.size(), llff.frames.size());
  for (std::size_t i = 0; i < json.frames.size(); ++i) {
    const FrameInfo &a = json.frames[i], &b = llff.frames[i];
    EXPECT_EQ(a.name, b.name);
    EXPECT_EQ(a.split, b.split);
    EXPECT_NEAR(a.camera.fx, b.camera.fx, 1e-3);
    EXPECT_EQ(a.camera.cy, b.camera.cy);
    for (int axis = 0; axis < 3; ++axis)
      EXPECT_LT(length(a.world_from_camera.axis(axis) - b.world_from_camera.axis(axis)), 1e-5) << a.name;
    EXPECT_LT(length(a.world_from_camera.t - b.world_from_camera.t), 1e-5) << a.name;
  }
}

TEST(RealData, Record3dDoor) {
  if (!fs::exists(data("record3d_door"))) GTEST_SKIP() << "the optional recording of a phone is not at hand";
  NamedDataset phone("record3d", {{"root", data("record3d_door")}});
  Diagnostics d;
  const LoadedScene s = load_scene(phone, {.width_px = 240}, d);
  // The tracker's poses do not fit the photographs; nothing else is wrong.
  for (const Diagnostic& x : d.all())
    EXPECT_TRUE(x.severity == Severity::note || x.code == "scene.camera.off") << x.text();
  EXPECT_TRUE(s.cameras_are_off());
  ASSERT_EQ(s.info.frames.size(), 86u);
  EXPECT_EQ(s.frames_of(Split::test).size(), 11u);
  EXPECT_EQ(s.info.frames[1].name, "4");
  EXPECT_EQ(s.info.frames.back().name, "344");  // the last of 345 poses, of 341 frames that were exported
  EXPECT_HAS(s.geometry, "poses agree with depth");
}

TEST(RealData, ShelfBinWithDepthAndLabels) {
  if (!fs::exists(data("shelf_bin"))) GTEST_SKIP() << "the optional shelf bin is not at hand";
  NamedDataset scene("transforms_json", {{"root", data("shelf_bin")}, {"test_every", "5"}});
  Diagnostics d;
  const LoadedScene s = load_scene(scene, {}, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(s.frames_of(Split::test).size(), 3u);
  EXPECT_EQ(s.info.classes.valid_count(), 4);
  EXPECT_TRUE(s.info.metric);
  std::int64_t labelled = 0;
  for (const auto& counts : s.class_pixels) labelled += counts[0] + counts[1] + counts[2] + counts[3];
  EXPECT_GT(labelled, 10000);
  EXPECT_HAS(s.bounds_from, "view cones");
}

TEST(RealData, ReplicaConventionsAreTold) {
  if (!fs::exists(data("replica_apartment0"))) GTEST_SKIP() << "the optional Replica frames are not at hand";
  NamedDataset replica = replica_of(data("replica_apartment0"));
  expect_conventions_told(replica, "poses agree with depth");
}

TEST(RealData, StudioRoomConventionsAreToldFromPhotographs) {
  if (!fs::exists(data("studio_room"))) GTEST_SKIP() << "the optional studio photographs are not at hand";
  NamedDataset by_json("transforms_json", {{"root", data("studio_room")}});
  expect_conventions_told(by_json, "poses agree with the photographs");
  NamedDataset by_colmap("colmap", {{"root", data("studio_room")}});
  expect_conventions_told(by_colmap, "poses agree with the photographs");
}

TEST(RealData, ShelfBinConventionsAreToldFromSparseDepth) {
  if (!fs::exists(data("shelf_bin"))) GTEST_SKIP() << "the optional shelf bin is not at hand";
  NamedDataset scene("transforms_json", {{"root", data("shelf_bin")}});
  expect_conventions_told(scene, "poses agree with depth");
}

}  // namespace
}  // namespace semfield
