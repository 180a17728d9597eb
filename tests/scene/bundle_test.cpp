// Bundle adjustment against cameras that are known: what was made wrong comes back.
#include "scene/survey/bundle.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "loading/depth_images.h"

namespace semfield {
namespace {

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
  Camera wrong = t.camera;
  wrong.fx = wrong.fy = 585;
  wrong.cx = 320;
  wrong.cy = 240;
  wrong.k1 = 0;
  t.state_lens(wrong);
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
  for (int c = 0; c < 3; ++c) {
    const Vec3d axis = color.rotate({depth_from_color.r[static_cast<std::size_t>(c)][0],
                                     depth_from_color.r[static_cast<std::size_t>(c)][1],
                                     depth_from_color.r[static_cast<std::size_t>(c)][2]});
    for (int r = 0; r < 3; ++r) out.r[static_cast<std::size_t>(r)][static_cast<std::size_t>(c)] = axis[r];
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
  const std::vector<float> same = drawn_depth(image, {lens, {}}, lens);
  int drawn = 0;
  for (std::size_t i = 0; i < same.size(); ++i) {
    if (same[i] == 0) continue;
    ++drawn;
    EXPECT_NEAR(same[i], own.depth_m[i], 0.02f * own.depth_m[i]) << i;
  }
  EXPECT_GT(drawn, 0.95 * 160 * 120);

  Pose motion = moved({}, {0, 0.03, 0, 0, 0, 0});
  motion.t = {0.05, 0, 0};
  const Camera other{.width_px = 200, .height_px = 160, .fx = 170, .fy = 170, .cx = 100, .cy = 80};
  const BundleDepth apart = walls(depth_pose(color, motion), other);
  const std::vector<float> seen = drawn_depth({200, 160, 1, apart.depth_m}, {other, motion}, lens);
  drawn = 0;
  for (std::size_t i = 0; i < seen.size(); ++i) {
    if (seen[i] == 0) continue;
    ++drawn;
    EXPECT_NEAR(seen[i], own.depth_m[i], 0.03f * own.depth_m[i]) << i;
  }
  EXPECT_GT(drawn, 0.8 * 160 * 120);
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
