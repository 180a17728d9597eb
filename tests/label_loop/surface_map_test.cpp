// Distances along the rays of a camera: rendering's own, near the truth once a room is learned.
#include "surface/surface_map.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "compute/parallel.h"
#include "session/trainer.h"
#include "testkit/analytic_scene.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

const std::string kDepth = "losses: [{type: depth, kind: line_of_sight, weight: 0.3, from_step: 0}]\n";

class LearnedRoom : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    registry_ = new Registry(make_registry());
    session_ = new Session(open_text(hash_config(kDepth), *registry_));
    const auto rays = session_->make_ray_source();
    Trainer trainer(*session_->pipeline, *rays, session_->config.adam, session_->config.schedule);
    while (trainer.step() < 200) trainer.advance();
  }
  static void TearDownTestSuite() {
    delete session_;
    delete registry_;
  }
  static RayCamera camera(std::size_t frame) {
    const FrameInfo& info = session_->scene.info.frames[frame];
    return {info.camera, info.world_from_camera, session_->plan.undistortion};
  }
  static SurfaceMap map_of(std::size_t frame, std::int32_t stride) {
    return make_surface_map(*session_->pipeline, camera(frame), session_->limits, stride, 200);
  }
  static Registry* registry_;
  static Session* session_;
};
Registry* LearnedRoom::registry_ = nullptr;
Session* LearnedRoom::session_ = nullptr;

TEST_F(LearnedRoom, DistancesAreNearTheTruth) {
  const double cell = 4.0 / 64;  // of the finest level, and of the occupancy grid 4 / 32
  for (const std::size_t frame : {0, 3, 5}) {
    const SurfaceMap map = map_of(frame, 2);
    EXPECT_EQ(map.width_px, 24);
    EXPECT_EQ(map.height_px, 18);
    EXPECT_EQ(map.step, 200);
    std::vector<double> wrong;
    for (std::int64_t i = 0; i < std::ssize(map.distance_m); ++i) {
      const PixelPlace pixel = strided_place(i, map.width_px, map.stride);
      const double found = static_cast<double>(map.distance_m[static_cast<std::size_t>(i)]);
      if (!(found > 0)) continue;
      double o[3], d[3], near_far[2];
      cast_ray(camera(frame), session_->limits, pixel.column, pixel.row, o, d, near_far);
      const testkit::AnalyticHit hit = testkit::intersect_analytic_room({o[0], o[1], o[2]}, {d[0], d[1], d[2]});
      wrong.push_back(std::abs(found - hit.t_m));
      const Vec3d place = point_at(camera(frame), session_->limits, pixel, found);
      EXPECT_NEAR(length(place - hit.point), wrong.back(), 1e-6);
    }
    EXPECT_GT(wrong.size(), map.distance_m.size() * 9 / 10);
    std::sort(wrong.begin(), wrong.end());
    EXPECT_LT(wrong[wrong.size() / 2], 2 * cell) << "frame " << frame;
  }
}

// Expected distance over opacity as rendering has them, and nothing where opacity is low.
TEST_F(LearnedRoom, TheyAreThoseOfRendering) {
  const RayCamera from = camera(1);
  std::vector<PixelPlace> pixels;
  std::vector<double> origin, direction, near_far;
  for (std::int32_t y = 0; y < from.camera.height_px; y += 5) {
    for (std::int32_t x = 0; x < from.camera.width_px; x += 3) {
      double o[3], d[3], nf[2];
      cast_ray(from, session_->limits, x, y, o, d, nf);
      pixels.push_back({x, y});
      origin.insert(origin.end(), o, o + 3);
      direction.insert(direction.end(), d, d + 3);
      near_far.insert(near_far.end(), nf, nf + 2);
    }
  }
  const std::int64_t count = std::ssize(pixels);
  std::vector<float> depth(pixels.size()), opacity(pixels.size());
  RenderJob<float> job;
  job.origin = {origin.data(), count, 3};
  job.direction = {direction.data(), count, 3};
  job.near_far = {near_far.data(), count, 2};
  job.depth = {depth.data(), count, 1};
  job.opacity = {opacity.data(), count, 1};
  session_->pipeline->render(job);
  const std::vector<float> found = surface_distances(*session_->pipeline, from, session_->limits, pixels);
  for (std::size_t i = 0; i < pixels.size(); ++i)
    EXPECT_EQ(found[i], opacity[i] < kSurfaceOpacity ? 0 : depth[i] / opacity[i]);
  EXPECT_TRUE(surface_distances(*session_->pipeline, from, session_->limits, {}).empty());
  // An empty ray: nothing is met behind the far limit.
  RayLimits none = session_->limits;
  none.near_m = 9;
  none.far_m = 9.5;
  for (const float nothing : surface_distances(*session_->pipeline, from, none, pixels)) EXPECT_EQ(nothing, 0);
}

TEST_F(LearnedRoom, AMapIsTheSameForAnyThreadsAndOfAnyStride) {
  set_thread_count(1);
  const SurfaceMap one = map_of(2, 3);
  set_thread_count(3);
  const SurfaceMap three = map_of(2, 3);
  set_thread_count(0);
  EXPECT_EQ(one.distance_m, three.distance_m);
  const SurfaceMap every = map_of(2, 1);
  ASSERT_EQ(every.distance_m.size(), 48u * 36u);
  for (std::int64_t i = 0; i < std::ssize(one.distance_m); ++i) {
    const PixelPlace at = strided_place(i, one.width_px, one.stride);
    EXPECT_EQ(one.distance_m[static_cast<std::size_t>(i)], every.at(at.column, at.row));
    EXPECT_EQ(one.at(at.column, at.row), every.at(at.column, at.row));
  }
  EXPECT_EQ(one.at(47, 35), one.distance_m.back());
  EXPECT_EQ(map_of(2, 1000).distance_m.size(), 1u) << "no stride is longer than the shorter side";
  EXPECT_TRUE(SurfaceMap().empty());
}

}  // namespace
}  // namespace semfield
