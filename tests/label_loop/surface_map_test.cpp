// Distances along the rays of a camera, near the truth once a room is learned, and what a view sees of the surface.
#include "compute/parallel.h"
#include "serve/view_pictures.h"
#include "session/trainer.h"
#include "surface/surface_graph.h"
#include "testkit/analytic_scene.h"
#include "tests/label_loop/seen_room.h"
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
      const double found = static_cast<double>(map.distance_m[i]);
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
  RenderJob<float> job{.origin = {origin.data(), count, 3},
                       .direction = {direction.data(), count, 3},
                       .near_far = {near_far.data(), count, 2},
                       .depth = {depth.data(), count, 1},
                       .opacity = {opacity.data(), count, 1}};
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
    EXPECT_EQ(one.distance_m[i], every.at(at.column, at.row));
    EXPECT_EQ(one.at(at.column, at.row), every.at(at.column, at.row));
  }
  EXPECT_EQ(one.at(47, 35), one.distance_m.back());
  EXPECT_EQ(map_of(2, 1000).distance_m.size(), 1u) << "no stride is longer than the shorter side";
  EXPECT_TRUE(SurfaceMap().empty());
}

// Places of the surface as cameras see them: the inverse of a ray, what is hidden, clicks of other views, the best
// photograph.

using namespace testing_loop;

constexpr double kTolerance_m = 0.05;

Vec3d place_at(const RayCamera& camera, const PixelPlace& pixel) {
  return point_at(camera, room_limits(), pixel, hit_at(camera, pixel).t_m);
}

Annotations::Mark mark(const std::string& id, int frame, std::vector<PixelPoint> points) {
  return {id, frame, std::move(points), 0, 0};
}

TEST(SurfaceSight, AProjectionIsTheInverseOfARay) {
  SeenRoom room;
  RayCamera camera = room.views[0].camera;
  for (const bool has_lens : {false, true}) {
    camera.undistort = has_lens;
    if (has_lens) {
      camera.camera.k1 = -0.12;
      camera.camera.p1 = 0.003;
    }
    for (std::int32_t row = 1; row < camera.camera.height_px; row += 7) {
      for (std::int32_t column = 1; column < camera.camera.width_px; column += 7) {
        const auto at = pixel_of(camera, point_at(camera, room_limits(), {column, row}, 1.7));
        ASSERT_TRUE(at.has_value()) << column << ", " << row;
        EXPECT_NEAR(at->x, column + 0.5, 1e-6);
        EXPECT_NEAR(at->y, row + 0.5, 1e-6);
      }
    }
  }
  EXPECT_FALSE(pixel_of(camera, camera.world_from_camera.t - camera.world_from_camera.axis(2)).has_value())
      << "behind the camera";
  EXPECT_FALSE(pixel_of(camera, camera.world_from_camera.apply({50, 0, 1})).has_value()) << "far off the axis";
}

TEST(SurfaceSight, AClickIsSeenInOtherViewsWhereNothingHidesIt) {
  SeenRoom room(1);
  std::vector<Annotations::Mark> marks;
  for (int k = 0; k < 40; ++k)
    marks.push_back(mark("m" + std::to_string(k), k % 2, {{(17 * k + 5) % 44 + 2.5, (11 * k + 7) % 32 + 2.5}}));
  std::vector<int> view_of_frame(room.views.size());
  for (std::size_t v = 0; v < room.views.size(); ++v) view_of_frame[v] = static_cast<int>(v);
  MarkPlaces places;
  places.set(marks, view_of_frame);
  int seen = 0, hidden = 0;
  for (int v = 1; v < std::ssize(room.views); ++v) {
    const PoolView& view = room.views[v];
    const std::vector<SeenMark> found =
        places.seen_by(view.camera, distance_in(view.map), v, room.views, room_limits(), kTolerance_m);
    for (const Annotations::Mark& m : marks) {
      const auto own = std::find_if(found.begin(), found.end(), [&](const SeenMark& s) { return s.id == m.id; });
      if (m.frame == v) {
        EXPECT_EQ(own, found.end()) << "a view's own click";
        continue;
      }
      const PixelPlace from{static_cast<std::int32_t>(m.points[0].x), static_cast<std::int32_t>(m.points[0].y)};
      const Vec3d place = place_at(room.views[m.frame].camera, from);
      const auto at = pixel_of(view.camera, place);
      const double before =
          at ? length(place_at(view.camera, {static_cast<std::int32_t>(at->x), static_cast<std::int32_t>(at->y)}) -
                      place)
             : 1e9;
      if (own != found.end()) {
        ++seen;
        EXPECT_EQ(own->points.size(), 1u);
        EXPECT_LT(before, 0.35) << m.id << " is shown on something else in view " << v;
      } else if (before > 0.35) {
        ++hidden;
      } else {
        EXPECT_GT(before, 0.02) << m.id << " is not shown in view " << v;
      }
    }
  }
  EXPECT_GT(seen, 20);
  EXPECT_GT(hidden, 5);
}

TEST(SurfaceSight, PlacesFollowMapsAndMarks) {
  SeenRoom room(1);
  const std::vector<int> view_of_frame{0, 1, 2, 3, 4, 5};
  const PoolView& view = room.views[1];
  MarkPlaces places;
  const auto seen = [&] {
    return places.seen_by(view.camera, distance_in(view.map), 1, room.views, room_limits(), kTolerance_m);
  };
  std::vector<Annotations::Mark> marks;
  for (double x = 2.5; x < 46; x += 4) marks.push_back(mark("x" + std::to_string(x), 0, {{x, 20.5}}));
  places.set(marks, view_of_frame);
  const std::size_t first = seen().size();
  ASSERT_GT(first, 0u);
  for (float& way : room.views[0].map.distance_m) way *= 0.4F;  // the geometry is another
  room.views[0].map.step = 7;
  EXPECT_LT(seen().size(), first);
  marks[0].class_index = kVoid;
  for (Annotations::Mark& m : marks) m.class_index = kVoid;  // what is ignored is so in its own view
  places.set(marks, view_of_frame);
  EXPECT_TRUE(seen().empty());
  room.views[0].map = {};
  marks[0].class_index = 0;
  places.set(marks, view_of_frame);
  EXPECT_TRUE(seen().empty()) << "a view without a map";
}

TEST(SurfaceSight, TheBestPhotographShowsThePlace) {
  SeenRoom room(1);
  for (const PixelPlace pixel : {PixelPlace{24, 18}, {10, 30}, {40, 8}}) {
    const Vec3d place = place_at(room.views[2].camera, pixel);
    const auto spot = best_spot(room.views, place, kTolerance_m);
    ASSERT_TRUE(spot.has_value());
    const RayCamera& camera = room.views[spot->view].camera;
    const PixelPlace there{static_cast<std::int32_t>(spot->at.x), static_cast<std::int32_t>(spot->at.y)};
    EXPECT_LT(length(place_at(camera, there) - place), 0.35) << spot->view;
  }
  EXPECT_FALSE(best_spot(room.views, {100, 100, 100}, kTolerance_m).has_value()) << "outside of the room";
  for (int v = 0; v < std::ssize(room.views); ++v)
    EXPECT_EQ(nearest_view(room.views, room.views[v].camera.world_from_camera, 1), v);
}

}  // namespace
}  // namespace semfield
