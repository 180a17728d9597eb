// The analytic room as the views of a labelling session see it, with exact distances: surfaces without a field.
#pragma once

#include "surface/surface_graph.h"
#include "testkit/analytic_scene.h"

namespace semfield::testing_loop {

inline RayLimits room_limits() { return RayLimits{.near_m = 0.05, .far_m = 10}; }

inline testkit::AnalyticHit hit_at(const RayCamera& camera, const PixelPlace& pixel) {
  double o[3], d[3], near_far[2];
  cast_ray(camera, room_limits(), pixel.column, pixel.row, o, d, near_far);
  return testkit::intersect_analytic_room({o[0], o[1], o[2]}, {d[0], d[1], d[2]});
}

/// Views of every frame of the room, at a stride.
struct SeenRoom {
  SceneInfo info;
  std::vector<StoredFrame> photos;
  std::vector<PoolView> views;

  explicit SeenRoom(std::int32_t stride = 2, int frames = 6) {
    testkit::AnalyticSceneOptions options{.frames = frames};
    const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
    Diagnostics diagnostics;
    info = scene->open(diagnostics);
    photos.reserve(info.frames.size());
    for (std::size_t f = 0; f < info.frames.size(); ++f) {
      FrameBuffer buffer;
      scene->read(static_cast<int>(f), buffer);
      photos.emplace_back(std::move(buffer));
      PoolView view{.frame = static_cast<int>(f),
                    .camera = {info.frames[f].camera, info.frames[f].world_from_camera, false},
                    .photo = &photos.back()};
      SurfaceMap& map = view.map;
      map.stride = stride;
      map.width_px = strided_px(view.camera.camera.width_px, stride);
      map.height_px = strided_px(view.camera.camera.height_px, stride);
      for (std::int64_t i = 0; i < std::int64_t{map.width_px} * map.height_px; ++i) {
        const AnalyticHit hit = hit_at(view.camera, strided_place(i, map.width_px, stride));
        map.distance_m.push_back(static_cast<float>(hit.t_m));
      }
      views.push_back(std::move(view));
    }
  }
  SeenRoom(const SeenRoom&) = delete;
  SeenRoom& operator=(const SeenRoom&) = delete;

 private:
  using AnalyticHit = testkit::AnalyticHit;
};

}  // namespace semfield::testing_loop
