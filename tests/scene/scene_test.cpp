// Cameras: pixel centres, lens and its inverse, resizing; files of cameras, and paths of them.

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <set>

#include "core/files.h"
#include "scene/camera.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_files.h"
#include "tests/scene/bundle_error.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

Camera lens_camera() {
  return Camera{.width_px = 640, .height_px = 480, .fx = 500, .fy = 510, .cx = 322.5, .cy = 236.25};
}

TEST(Camera, DirectionIsUnitAndLooksForwardAtThePrincipalPoint) {
  const Camera c = lens_camera();
  const Vec3d d = c.direction(c.cx, c.cy);
  EXPECT_EQ(d.x, 0.0);
  EXPECT_EQ(d.y, 0.0);
  EXPECT_EQ(d.z, 1.0);
  EXPECT_NEAR(length(c.direction(1, 2)), 1.0, 1e-15);
  EXPECT_GT(c.direction(c.cx + 1, c.cy).x, 0.0);
  EXPECT_GT(c.direction(c.cx, c.cy + 1).y, 0.0);
}

TEST(Camera, ProjectUndoesDirectionThroughAStrongLens) {
  Camera c = lens_camera();
  c.k1 = -0.28;
  c.k2 = 0.07;
  c.k3 = -0.002;
  c.k4 = 0.0004;
  c.p1 = 0.0011;
  c.p2 = -0.0007;
  for (int y = 0; y <= 480; y += 60) {
    for (int x = 0; x <= 640; x += 64) {
      const Vec3d d = c.direction(x, y);
      ASSERT_GT(d.z, 0.0) << x << " " << y;
      double u = 0, v = 0;
      c.project(d * 3.7, u, v);
      EXPECT_NEAR(u, x, 1e-9);
      EXPECT_NEAR(v, y, 1e-9);
    }
  }
}

TEST(Camera, KnownDistortionByHand) {
  Camera c{.width_px = 2, .height_px = 2, .fx = 1, .fy = 1, .k1 = 0.1, .k4 = 0.01, .p1 = 0.02, .p2 = 0.03};
  double u = 0, v = 0;
  c.project({1, 0.5, 1}, u, v);
  // s = 1.25: g = 1 + 0.125 + 0.01 * 1.25^4 = 1.1494140625; x g + 2 p1 x y + p2 (s + 2 x^2) = 1.149... + 0.02 + 0.0975
  EXPECT_NEAR(u, 1.1494140625 + 0.02 + 0.0975, 1e-15);
  EXPECT_NEAR(v, 0.5 * 1.1494140625 + 0.02 * (1.25 + 0.5) + 2 * 0.03 * 0.5, 1e-15);
}

Camera fisheye_camera() {
  Camera c = lens_camera();
  c.lens = LensKind::fisheye;
  c.fx = 190;
  c.fy = 188;
  c.k1 = -0.021;
  c.k2 = 0.0043;
  c.k3 = -0.0021;
  c.k4 = 0.00031;
  return c;
}
Camera panorama_camera() {
  Camera c = lens_camera();
  c.lens = LensKind::equirectangular;
  c.fx = c.width_px / (2 * M_PI);
  c.fy = c.height_px / M_PI;
  c.cx = 0.5 * c.width_px;
  c.cy = 0.5 * c.height_px;
  return c;
}

// The formulas of OpenCV's documentation of its fisheye model, on their own: a = x / z, b = y / z, r^2 = a^2 + b^2,
// theta = atan(r), theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), x' = (theta_d / r) a.
TEST(Camera, AFisheyeProjectsAsOpenCvSays) {
  const Camera c = fisheye_camera();
  for (const Vec3d p : {Vec3d{0.3, -0.2, 1}, Vec3d{-2, 0.7, 0.9}, Vec3d{1e-4, 2e-5, 3}, Vec3d{5, 4, 0.1}}) {
    const double a = p.x / p.z, b = p.y / p.z, r = std::sqrt(a * a + b * b), t = std::atan(r);
    const double td =
        t * (1 + c.k1 * std::pow(t, 2) + c.k2 * std::pow(t, 4) + c.k3 * std::pow(t, 6) + c.k4 * std::pow(t, 8));
    double u = 0, v = 0;
    ASSERT_TRUE(c.sees(p));
    c.project(p, u, v);
    EXPECT_NEAR(u, c.fx * td / r * a + c.cx, 1e-10);
    EXPECT_NEAR(v, c.fy * td / r * b + c.cy, 1e-10);
  }
}

TEST(Camera, PixelsOfWideLensesComeBack) {
  for (const Camera& c : {fisheye_camera(), panorama_camera()}) {
    int rays = 0;
    for (int y = 0; y < c.height_px; y += 7) {
      for (int x = 0; x < c.width_px; x += 7) {
        const Vec3d d = c.direction(x + 0.5, y + 0.5);
        if (d == Vec3d{0, 0, 0}) continue;
        ++rays;
        EXPECT_NEAR(length(d), 1, 1e-15);
        EXPECT_NEAR(c.depth_of(d * 3.0), 3, 1e-14) << "depth is the distance";
        double u = 0, v = 0;
        ASSERT_TRUE(c.sees(d * 3.7));
        c.project(d * 3.7, u, v);
        EXPECT_NEAR(u, x + 0.5, 1e-9);
        EXPECT_NEAR(v, y + 0.5, 1e-9);
      }
    }
    EXPECT_EQ(rays, 92 * 69) << "every pixel has a ray";
  }
}

TEST(Camera, AFisheyeSeesBehindItselfAndNotBeyondItsFold) {
  Camera c = fisheye_camera();
  c.k1 = c.k2 = c.k3 = c.k4 = 0;
  EXPECT_LT(c.direction(c.cx + 1.7 * c.fx, c.cy).z, 0) << "1.7 radians off the axis";
  EXPECT_EQ(c.direction(c.cx + 3.2 * c.fx, c.cy), (Vec3d{0, 0, 0})) << "more than all around";
  EXPECT_EQ(c.direction(c.cx, c.cy), (Vec3d{0, 0, 1}));
  c.k1 = -0.2;  // theta (1 - 0.2 theta^2) grows up to 1.29, where it is 0.861
  EXPECT_EQ(c.direction(c.cx + 0.87 * c.fx, c.cy), (Vec3d{0, 0, 0}));
  EXPECT_NEAR(std::acos(c.direction(c.cx + 0.85 * c.fx, c.cy).z), 1.18, 0.05);
  EXPECT_FALSE(c.sees({0, 3, -1}));
  EXPECT_TRUE(c.sees({0, 3, 1}));
}

TEST(Camera, APanoramaHasForwardInItsMiddleAndRightToTheRight) {
  const Camera c = panorama_camera();
  const auto is = [&](double u, double v, Vec3d d) {
    EXPECT_LT(length(c.direction(u, v) - d), 1e-15) << u << ' ' << v;
  };
  is(320, 240, {0, 0, 1});
  is(480, 240, {1, 0, 0});
  is(160, 240, {-1, 0, 0});
  is(0, 240, {0, 0, -1});
  is(320, 0, {0, -1, 0});
  is(320, 480, {0, 1, 0});
  EXPECT_EQ(c.direction(320, 481), (Vec3d{0, 0, 0}));
  Camera turned = c;
  turned.cx = 100;  // forward lies elsewhere; what leaves the image at one side comes in at the other
  double u = 0, v = 0;
  turned.project(turned.direction(600.5, 30.5), u, v);
  EXPECT_NEAR(u, 600.5, 1e-9);
  EXPECT_NEAR(v, 30.5, 1e-9);
}

TEST(Camera, ResizedSeesTheSameDirections) {
  Camera c = lens_camera();
  c.k1 = -0.1;
  const Camera half = c.resized(320, 120);
  EXPECT_EQ(half.width_px, 320);
  // The corner of the image stays the corner; with centres at +0.5 a point (u, v) moves to (u / 2, v / 4).
  const Vec3d a = c.direction(640, 480), b = half.direction(320, 120);
  EXPECT_NEAR(a.x, b.x, 1e-13);
  EXPECT_NEAR(a.y, b.y, 1e-13);
  EXPECT_NEAR(half.cx, 161.25, 1e-12);
  EXPECT_NEAR(half.cy, 59.0625, 1e-12);
}

// Cameras as a file: what was written is read to the bit. What cannot be a camera: tests/bad_files/runs.cases.

CameraSet two_cameras() {
  CameraSet set;
  const Pose pose = look_along({1.0 / 3, -2e-7, 1e5 / 7}, {0.3, 0.7, -0.1}, {0, 0, 1});
  set.cameras.push_back({"rgb/0001",
                         {640, 480, 500.1, 501.0 / 3, 320.5, 239.7, 0.1, -0.02, 1e-3, 2e-4, 3e-5, -1e-5},
                         pose,
                         0.1,
                         20.0 / 3});
  set.cameras.push_back({"a \"b\" \xC3\xA4", {8, 6, 8, 8, 4, 3}, {}, 0, 0});
  return set;
}

TEST(CameraSet, IsReadBackToTheBit) {
  const std::string path = fresh_folder("cameras") + "/cameras.json";
  for (const bool z_depth : {false, true}) {
    CameraSet set = two_cameras();
    set.z_depth = z_depth;
    if (z_depth) set.cameras[1].camera.lens = LensKind::fisheye;
    write_cameras(path, set);
    EXPECT_TRUE(is_camera_set(path));
    Diagnostics diagnostics;
    const CameraSet read = read_cameras(path, diagnostics);
    EXPECT_TRUE(diagnostics.all().empty());
    EXPECT_EQ(read.z_depth, z_depth);
    ASSERT_EQ(read.cameras.size(), 2U);
    for (std::size_t i = 0; i < 2; ++i) {
      const PlacedCamera &a = set.cameras[i], &b = read.cameras[i];
      const Camera &c = a.camera, &d = b.camera;
      EXPECT_EQ(a.name, b.name);
      EXPECT_EQ((std::array{c.width_px, c.height_px}), (std::array{d.width_px, d.height_px}));
      EXPECT_EQ((std::array{c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.k3, c.k4, c.p1, c.p2}),
                (std::array{d.fx, d.fy, d.cx, d.cy, d.k1, d.k2, d.k3, d.k4, d.p1, d.p2}));
      EXPECT_EQ(c.lens, d.lens);
      EXPECT_EQ(a.world_from_camera.r, b.world_from_camera.r);
      EXPECT_EQ(a.world_from_camera.t, b.world_from_camera.t);
      EXPECT_EQ((std::array{a.near_m, a.far_m}), (std::array{b.near_m, b.far_m}));
    }
    const std::string first = read_text_file(path);
    write_cameras(path, read);
    EXPECT_EQ(read_text_file(path), first);
  }
}

TEST(CameraSet, RowsOfNumbersAreNone) {
  const std::string path = fresh_folder("rows") + "/path.txt";
  plain_write(path, "# first\n1 0 0 0 0 1 0 0 0 0 1 0\n");
  EXPECT_FALSE(is_camera_set(path));
  plain_write(path, "");
  EXPECT_FALSE(is_camera_set(path));
  plain_write(path, "\r\n\t {}");
  EXPECT_TRUE(is_camera_set(path));
}

// Smooth camera paths, and axes of pose files; their layouts: tests/bad_files/runs.cases.

TEST(CameraPath, LookAlongIsLevelAndLooksThere) {
  const Pose p = look_along({1, 2, 3}, {0, 2, 0}, {0, 0, 1});
  EXPECT_EQ(p.axis(2), (Vec3d{0, 1, 0}));
  EXPECT_EQ(p.axis(0), (Vec3d{1, 0, 0}));
  EXPECT_EQ(p.axis(1), (Vec3d{0, 0, -1}));
  const Pose down = look_along({0, 0, 0}, {0, 0, -1}, {0, 0, 1});
  EXPECT_NEAR(length(down.axis(0)), 1, 1e-12);
  EXPECT_NEAR(dot(down.axis(0), down.axis(2)), 0, 1e-12);
}

// Cases F06 and F09 of tests/numerics have rotations that are almost sound, and pixels beyond a lens's fold.
TEST(CameraFile, AxesTurnIntoRightDownForward) {
  const std::string path = fresh_folder("poses") + "/poses.txt";
  plain_write(path, "1 0 0 0 0 1 0 0 0 0 1 0\n");
  const auto axes = [&](CameraAxes a) {
    const Pose p = read_camera_file(path, a)[0];
    return std::array<Vec3d, 3>{p.axis(0), p.axis(1), p.axis(2)};
  };
  EXPECT_EQ(axes(CameraAxes::right_down_forward), (std::array<Vec3d, 3>{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}));
  EXPECT_EQ(axes(CameraAxes::right_up_backward), (std::array<Vec3d, 3>{{{1, 0, 0}, {0, -1, 0}, {0, 0, -1}}}));
  EXPECT_EQ(axes(CameraAxes::left_up_forward), (std::array<Vec3d, 3>{{{-1, 0, 0}, {0, -1, 0}, {0, 0, 1}}}));
}

TEST(SmoothPath, MeetsItsKeysAndTurnsLittleFromFrameToFrame) {
  // Turns about every axis, half turns among them: each of the four ways to a quaternion is taken.
  std::vector<Pose> keys;
  for (const Vec3d forward : {Vec3d{1, 0, 0}, {0, 1, 0.2}, {-1, 0.3, 0}, {-0.2, -1, 0.4}, {0.9, -0.1, -0.3}})
    keys.push_back(look_along(forward * 2.0, forward, {0, 0, 1}));
  for (const Vec3d axis : {Vec3d{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}) {
    Pose half;  // 2 a a^T - 1
    for (int row = 0; row < 3; ++row) {
      for (int col = 0; col < 3; ++col) half.r[row][col] = 2 * axis[row] * axis[col] - (row == col ? 1 : 0);
    }
    keys.push_back(half);
  }
  const int between = 50, count = between * static_cast<int>(keys.size() - 1) + 1;
  const std::vector<Pose> path = make_smooth_path(keys, count);
  ASSERT_EQ(path.size(), static_cast<std::size_t>(count));
  for (std::size_t k = 0; k < keys.size(); ++k) {
    const Pose& met = path[k * between];
    for (int axis = 0; axis < 3; ++axis) EXPECT_LT(length(met.axis(axis) - keys[k].axis(axis)), 1e-9) << k;
    EXPECT_LT(length(met.t - keys[k].t), 1e-9) << k;
  }
  for (std::size_t i = 0; i < path.size(); ++i) {
    EXPECT_NEAR(dot(cross(path[i].axis(0), path[i].axis(1)), path[i].axis(2)), 1, 1e-9);
    if (i == 0) continue;
    EXPECT_GT(dot(path[i].axis(2), path[i - 1].axis(2)), std::cos(0.2)) << i;
    EXPECT_LT(length(path[i].t - path[i - 1].t), 0.2) << i;
  }
  EXPECT_EQ(make_smooth_path({keys[0]}, 3).size(), 3U);
}

// Class tables: numbering and names. Their files: tests/bad_files/classes.cases.

using testing_room::fresh_folder;

TEST(ClassTable, NumbersValidClassesInOrderOfId) {
  const ClassTable t(
      {{7, "chair", {1, 2, 3}, false}, {0, "void", {}, true}, {3, "wall", {}, false}, {9, "hand", {}, true}});
  EXPECT_EQ(t.valid_count(), 2);
  const std::pair<int, int> indices[] = {{3, 0}, {7, 1}, {0, kVoid}, {9, kVoid}, {4, -2}, {1000, -2}, {-1, -2}};
  for (const auto& [id, index] : indices) EXPECT_EQ(t.index_of(id), index) << id;
  EXPECT_EQ(t.id_of(1), 7);
  EXPECT_EQ(t.id_of(kVoid), 0);
  EXPECT_EQ(t.valid(1).name, "chair");
  std::vector<ClassEntry> many;
  for (int i = 0; i < 1025; ++i) many.push_back({i, "c", {}, false});
  EXPECT_HAS(error_of([&] { (void)ClassTable(many); }), "1025", "1024");
  EXPECT_HAS(error_of([] { (void)published_classes("nyu"); }), "nyu", "class table");
}

TEST(ClassTable, DefaultColorsDiffer) {
  std::set<std::array<std::uint8_t, 3>> seen;
  for (int id = 0; id < 200; ++id) seen.insert(ClassTable::default_color(id));
  EXPECT_EQ(seen.size(), 200u);
}

TEST(ClassNames, VoidIsFoundAndAdded) {
  const ClassTable table = table_of_names({"chair", "Unlabelled", "wall"});
  EXPECT_EQ(table.index_of(0), kVoid);
  EXPECT_EQ(table.entries()[0].name, "Unlabelled");
  EXPECT_EQ(table.valid(1).name, "wall");
  EXPECT_EQ(table.valid(1).id, 2);
  EXPECT_EQ(ClassNames(table).index_of("Unlabelled", "here"), kVoid);
  EXPECT_EQ(ClassNames(table).index_of("other", "here"), kVoid);
  EXPECT_EQ(ClassNames(ClassTable({{3, "other", {}, false}})).index_of("other", "here"), 0);
  EXPECT_EQ(with_void({{0, "a", {}, false}, {1, "b", {}, false}}).index_of(2), kVoid);
  EXPECT_HAS(error_of([&] { (void)ClassNames(table).index_of("chiar", "here"); }), "chiar", "chair");
}

TEST(ClassNames, VoidWordsOfTools) {
  for (const char* name : {"void", "VOID", "__ignore__", "_background_", "__background__", "<unlabeled>", "(none)",
                           "No-label", "don't care", "Unassigned", "other"})
    EXPECT_TRUE(is_void_name(name)) << name;
  for (const char* name : {"background", "avoid", "others", "other furniture", "", "__", "ignored items"})
    EXPECT_FALSE(is_void_name(name)) << name;
  EXPECT_TRUE(is_void_entry(0, "other"));
  EXPECT_FALSE(is_void_entry(5, "other"));
  EXPECT_TRUE(is_void_entry(5, "ignore"));
}

TEST(ClassNames, ANameOfTwoClassesIsRefusedWhereItIsUsed) {
  const ClassNames names(ClassTable({{1, "chair", {}, false}, {2, "wall", {}, false}, {5, "chair", {}, false}}));
  EXPECT_EQ(names.index_of("wall", "here"), 1);
  EXPECT_HAS(error_of([&] { (void)names.index_of("chair", "here"); }), "here: the class table has 'chair' twice");
}

// Bundle adjustment against cameras that are known: what was made wrong comes back.

constexpr double kDegree = M_PI / 180;

// A room of points on five walls, walked through by `frames` cameras.
struct Truth {
  Camera camera{.width_px = 640, .height_px = 480, .fx = 520, .fy = 520, .cx = 322, .cy = 236, .k1 = -0.05};
  std::vector<Pose> poses;
  Bundle bundle;  // as the truth is; tests spoil `given` and `stated`

  explicit Truth(int frames = 14, double noise_px = 0.3, int points = 600) {
    std::mt19937 random(7);
    std::uniform_real_distribution<double> uniform(-1, 1);
    std::normal_distribution<double> noise(0, noise_px);
    for (int i = 0; i < frames; ++i) {
      const double along = static_cast<double>(i) / frames - 0.5;
      poses.push_back(moved({}, {0.1 * std::sin(3 * along), 0.5 * along, 0.03 * along, 0, 0, 0}));
      poses.back().t = {0.8 * along, 0.1 * std::sin(6 * along), 0.2 * std::cos(4 * along)};
    }
    for (int i = 0; i < points; ++i) {
      Vec3d p{2 * uniform(random), 1.2 * uniform(random), 3 + 0.8 * uniform(random)};
      if (i % 3 == 0) p.z = 4;
      if (i % 3 == 1) p.x = p.x < 0 ? -1.8 : 1.8;
      Track track;
      track.point = p;
      for (int f = 0; f < frames; ++f) {
        const Vec3d q = poses[static_cast<std::size_t>(f)].apply_inverse(p);
        double u = 0, v = 0;
        if (!camera.sees(q)) continue;
        camera.project(q, u, v);
        if (u > 0 && v > 0 && u < 640 && v < 480) track.seen.push_back({f, u + noise(random), v + noise(random)});
      }
      if (track.seen.size() > 1) bundle.tracks.push_back(track);
    }
    bundle.stated.assign(poses.size(), camera);
    bundle.given = bundle.poses = poses;
    bundle.lens_of.assign(poses.size(), 0);
    bundle.lenses.resize(1);
    bundle.measure();
  }

  void state_lens(const Camera& wrong) { bundle.stated.assign(poses.size(), wrong); }
  void shake(double turn_deg, double shift) {
    std::mt19937 random(3);
    std::normal_distribution<double> one(0, 1);
    for (Pose& pose : bundle.given) {
      std::array<double, 6> by{};
      for (int k = 0; k < 6; ++k)
        by[static_cast<std::size_t>(k)] = one(random) * (k < 3 ? turn_deg * kDegree : shift) / std::sqrt(3.0);
      pose = moved(pose, by);
    }
    bundle.poses = bundle.given;
  }
  void settle() {
    std::erase_if(bundle.tracks, [&](Track& track) { return !settle_point(bundle, track); });
    ASSERT_GT(bundle.tracks.size(), 400u);
    bundle.measure();
  }
};

void adjust_in_rounds(Truth& t, BundleOptions options = {}) {
  for (const bool lens : {false, true, true}) {
    options.move_lens = lens;
    options.outlier_px = lens ? 1 : 4;
    adjust(t.bundle, options);
  }
}

TEST(Bundle, RightCamerasStayWhereTheyAre) {
  Truth t;
  t.settle();
  adjust_in_rounds(t);
  EXPECT_NEAR(t.bundle.camera(0).fx, t.camera.fx, 1.5);
  for (std::size_t i = 0; i < t.poses.size(); ++i) EXPECT_LT(length(t.bundle.poses[i].t - t.poses[i].t), 0.004);
  EXPECT_LT(median_error_px(t.bundle), 0.45);
}

TEST(Bundle, AWrongLensComesBack) {
  Truth t;
  t.state_lens({.width_px = 640, .height_px = 480, .fx = 585, .fy = 585, .cx = 320, .cy = 240});
  t.settle();
  const double before = median_error_px(t.bundle);
  adjust_in_rounds(t);
  const Camera found = t.bundle.camera(0);
  EXPECT_GT(before, 3);
  EXPECT_LT(median_error_px(t.bundle), 0.45);
  EXPECT_NEAR(found.fx, 520, 3);
  EXPECT_NEAR(found.fy, 520, 3);
  EXPECT_NEAR(found.k1, -0.05, 0.01);
}

TEST(Bundle, NoiseOfPosesGoes) {
  Truth t;
  t.shake(1, 0.02);
  t.settle();
  const double before = median_error_px(t.bundle);
  adjust_in_rounds(t, {.move_focal = false});
  EXPECT_GT(before, 2);
  EXPECT_LT(median_error_px(t.bundle), 0.5);
  // The given poses hold the world, so that it stays as it was but for the mean of their noise.
  for (std::size_t i = 0; i < t.poses.size(); ++i) EXPECT_LT(length(t.bundle.poses[i].t - t.poses[i].t), 0.03) << i;
}

TEST(Bundle, WithoutWhatPhotographsSayGivenPosesStand) {
  Truth t(6, 0.3, 40);
  t.bundle.tracks.clear();
  const std::vector<Pose> before = t.bundle.poses;
  adjust(t.bundle, {});
  for (std::size_t i = 0; i < before.size(); ++i) EXPECT_EQ(length(t.bundle.poses[i].t - before[i].t), 0);
}

TEST(Bundle, MatchesThatAreWrongDoNotPull) {
  Truth t;
  std::mt19937 random(5);
  std::uniform_real_distribution<double> x(0, 640), y(0, 480);
  for (std::size_t i = 0; i < t.bundle.tracks.size(); i += 8)
    t.bundle.tracks[i].seen[0] = {t.bundle.tracks[i].seen[0].frame, x(random), y(random)};
  adjust_in_rounds(t);
  EXPECT_NEAR(t.bundle.camera(0).fx, 520, 4);
}

// The wall z = 4 and the sides, as a depth camera beside sees them.
BundleDepth walls(const Pose& world_from_depth, const Camera& camera) {
  BundleDepth out{camera, {}};
  const Box room{{-1.8, -1.2, -9}, {1.8, 1.2, 4}};
  for (int y = 0; y < camera.height_px; ++y) {
    for (int x = 0; x < camera.width_px; ++x) {
      const Vec3d ray = camera.direction(x + 0.5, y + 0.5);
      double near = 0, far = 0;
      intersect(room, world_from_depth.t, world_from_depth.rotate(ray), near, far);
      out.depth_m.push_back(static_cast<float>(far * ray.z));
    }
  }
  return out;
}

// depth_from_color applied before world_from_color's inverse.
Pose depth_pose(const Pose& color, const Pose& depth_from_color) {
  Pose out;
  for (std::size_t c = 0; c < 3; ++c) {
    const auto& row = depth_from_color.r[c];
    const Vec3d axis = color.rotate({row[0], row[1], row[2]});
    for (int r = 0; r < 3; ++r) out.r[static_cast<std::size_t>(r)][c] = axis[r];
  }
  out.t = color.apply(depth_from_color.apply_inverse({}));
  return out;
}

TEST(Bundle, ADepthCameraBesideTheColoursIsFound) {
  Truth t;
  std::erase_if(t.bundle.tracks, [](const Track& track) { return track.point.z != 4; });
  Truth sides;
  for (const Track& track : sides.bundle.tracks)
    if (std::abs(track.point.x) == 1.8 && track.point.z < 4) t.bundle.tracks.push_back(track);
  Pose motion = moved({}, {0.01, -0.02, 0.005, 0, 0, 0});
  motion.t = {0.025, -0.004, 0.006};
  const Camera lens{.width_px = 160, .height_px = 120, .fx = 146, .fy = 146, .cx = 80, .cy = 60};
  for (const Pose& pose : t.poses) t.bundle.depth.push_back(walls(depth_pose(pose, motion), lens));
  EXPECT_LT(share_on_depth(t.bundle), 0.9);
  align_depth(t.bundle);
  EXPECT_GT(share_on_depth(t.bundle), 0.95);
  EXPECT_NEAR(t.bundle.depth_from_color.t.x, 0.025, 0.008);
  EXPECT_NEAR(t.bundle.depth_from_color.t.z, 0.006, 0.004);
}

// Where both cameras are one, depth comes out as it went in; from beside it is what the colour camera would have seen.
TEST(DepthCamera, DepthIsDrawnWhereTheColoursSeeIt) {
  const Camera lens{.width_px = 160, .height_px = 120, .fx = 146, .fy = 146, .cx = 80, .cy = 60};
  const Pose color;
  const BundleDepth own = walls(color, lens);
  const Image<float> image{160, 120, 1, own.depth_m};
  const auto expect_own = [&](const std::vector<float>& drawn, float off, double share) {
    int pixels = 0;
    for (std::size_t i = 0; i < drawn.size(); ++i) {
      if (drawn[i] == 0) continue;
      ++pixels;
      EXPECT_NEAR(drawn[i], own.depth_m[i], off * own.depth_m[i]) << i;
    }
    EXPECT_GT(pixels, share * 160 * 120);
  };
  expect_own(drawn_depth(image, {lens, {}}, lens), 0.02f, 0.95);

  Pose motion = moved({}, {0, 0.03, 0, 0, 0, 0});
  motion.t = {0.05, 0, 0};
  const Camera other{.width_px = 200, .height_px = 160, .fx = 170, .fy = 170, .cx = 100, .cy = 80};
  const BundleDepth apart = walls(depth_pose(color, motion), other);
  expect_own(drawn_depth({200, 160, 1, apart.depth_m}, {other, motion}, lens), 0.03f, 0.8);
}

TEST(DepthCamera, TheNearestSurfaceHidesWhatIsBehindAndEdgesAreLeftOpen) {
  const Camera lens{.width_px = 60, .height_px = 40, .fx = 60, .fy = 60, .cx = 30, .cy = 20};
  Image<float> image{60, 40, 1, std::vector<float>(60 * 40, 4.0f)};
  for (int y = 0; y < 40; ++y)
    for (int x = 0; x < 20; ++x) image.pixels[static_cast<std::size_t>(60 * y + x)] = 1;
  Pose motion;
  motion.t = {-0.2, 0, 0};  // the colour camera stands to the left: the near wall covers more of the far one
  const std::vector<float> seen = drawn_depth(image, {lens, motion}, lens);
  const auto at = [&](int x) { return seen[static_cast<std::size_t>(60 * 20 + x)]; };
  for (const int x : {20, 26, 29}) EXPECT_NEAR(at(x), 1, 1e-4) << "near wall, seen further right, at " << x;
  EXPECT_NEAR(at(50), 4, 1e-3);
  for (int x = 0; x < 60; ++x)
    EXPECT_TRUE(at(x) == 0 || std::abs(at(x) - 1) < 1e-3 || std::abs(at(x) - 4) < 1e-2) << "nothing between, at " << x;
}

}  // namespace
}  // namespace semfield
