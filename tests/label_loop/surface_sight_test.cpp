// Places of the surface as cameras see them: the inverse of a ray, what is hidden, clicks of other views, the best
// photograph.
#include "serve/surface_sight.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <string>
#include <vector>

#include "tests/label_loop/seen_room.h"

namespace semfield {
namespace {

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
    const PoolView& view = room.views[static_cast<std::size_t>(v)];
    const std::vector<SeenMark> found =
        places.seen_by(view.camera, distance_in(view.map), v, room.views, room_limits(), kTolerance_m);
    for (const Annotations::Mark& m : marks) {
      const auto own = std::find_if(found.begin(), found.end(), [&](const SeenMark& s) { return s.id == m.id; });
      if (m.frame == v) {
        EXPECT_EQ(own, found.end()) << "a view's own click";
        continue;
      }
      const PixelPlace from{static_cast<std::int32_t>(m.points[0].x), static_cast<std::int32_t>(m.points[0].y)};
      const Vec3d place = place_at(room.views[static_cast<std::size_t>(m.frame)].camera, from);
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
    const RayCamera& camera = room.views[static_cast<std::size_t>(spot->view)].camera;
    const PixelPlace there{static_cast<std::int32_t>(spot->at.x), static_cast<std::int32_t>(spot->at.y)};
    EXPECT_LT(length(place_at(camera, there) - place), 0.35) << spot->view;
  }
  EXPECT_FALSE(best_spot(room.views, {100, 100, 100}, kTolerance_m).has_value()) << "outside of the room";
  for (int v = 0; v < std::ssize(room.views); ++v)
    EXPECT_EQ(nearest_view(room.views, room.views[static_cast<std::size_t>(v)].camera.world_from_camera, 1), v);
}

}  // namespace
}  // namespace semfield
