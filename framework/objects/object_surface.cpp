#include "objects/object_surface.h"

#include <algorithm>
#include <cmath>
#include <map>

#include "compute/parallel.h"

namespace semfield {

std::vector<PoolView> object_views(Session& session, std::int64_t rays, const ObjectProgress& progress) {
  std::vector<PoolView> views;
  double pixels = 0;
  std::int32_t shortest = 1 << 20;
  for (const int f : session.scene.frames_of(Split::train)) {
    const auto n = static_cast<std::size_t>(f);
    const FrameInfo& info = session.scene.info.frames[n];
    if (session.scene.frames[n].is_unusable()) continue;
    PoolView view;
    view.frame = f;
    view.camera = {info.camera, info.world_from_camera, session.plan.undistortion};
    view.photo = &session.scene.frames[n];
    pixels += static_cast<double>(info.camera.width_px) * info.camera.height_px;
    shortest = std::min({shortest, info.camera.width_px, info.camera.height_px});
    views.push_back(std::move(view));
  }
  const auto stride = std::clamp(static_cast<std::int32_t>(std::ceil(std::sqrt(pixels / static_cast<double>(rays)))), 1,
                                 std::max(1, shortest / 8));
  double done = 0;
  for (PoolView& view : views) {
    view.map = make_surface_map(*session.pipeline, view.camera, session.limits, stride, 0);
    if (progress) progress(++done, static_cast<double>(views.size()));
  }
  return views;
}

ObjectSurface object_surface(std::vector<PoolView> views, const RayLimits& limits, std::int64_t points) {
  ObjectSurface surface{std::move(views), {}};
  surface.pool = make_surface_pool(surface.views, limits, points);
  if (surface.pool.points.empty())
    throw Error(ErrorKind::data, "objects.surface.none", "no ray of a training view meets a surface",
                "train longer: the field is empty");
  return surface;
}

namespace {

// Places of a view by segment: `id_at` has the segment of a place of its map, 0: none; `class_of` its class.
template <class IdAt, class ClassOf>
SegmentSights sights_of(std::span<const std::int32_t> point_of, std::int64_t least, const IdAt& id_at,
                        const ClassOf& class_of) {
  std::map<std::int32_t, std::vector<std::int32_t>> points;
  for (std::size_t i = 0; i < point_of.size(); ++i) {
    if (point_of[i] < 0) continue;
    if (const std::int32_t id = id_at(i); id != 0) points[id].push_back(point_of[i]);
  }
  SegmentSights to;
  to.first.push_back(0);
  for (const auto& [id, of_segment] : points) {
    if (std::ssize(of_segment) < least) continue;
    to.point.insert(to.point.end(), of_segment.begin(), of_segment.end());
    to.segment.insert(to.segment.end(), of_segment.size(), to.segments());
    to.first.push_back(static_cast<std::int32_t>(to.point.size()));
    to.class_of.push_back(class_of(id));
  }
  return to;
}

}  // namespace

std::vector<SegmentSights> segment_sights(const ObjectSurface& surface, const SegmentSet& segments,
                                          std::int64_t least) {
  std::vector<SegmentSights> sights(surface.views.size());
  parallel_for(std::ssize(sights), [&](std::int64_t v) {
    const auto n = static_cast<std::size_t>(v);
    const PoolView& view = surface.views[n];
    const FrameSegments& of_frame = segments.frames[static_cast<std::size_t>(view.frame)];
    const auto id_at = [&](std::size_t i) {
      if (of_frame.empty()) return 0;
      const PixelPlace at = strided_place(static_cast<std::int64_t>(i), view.map.width_px, view.map.stride);
      return of_frame.at(at.column, at.row, view.camera.camera.width_px, view.camera.camera.height_px);
    };
    const auto class_of = [&](std::int32_t id) {
      const auto known = of_frame.class_of.find(id);
      return known == of_frame.class_of.end() ? kVoid : known->second;
    };
    sights[n] = sights_of(surface.pool.point_of_pixel[n], least, id_at, class_of);
  });
  return sights;
}

std::vector<SegmentSights> point_sights(const ObjectSurface& surface, std::span<const std::int32_t> id) {
  std::vector<SegmentSights> sights(surface.views.size());
  parallel_for(std::ssize(sights), [&](std::int64_t v) {
    const std::vector<std::int32_t>& point_of = surface.pool.point_of_pixel[static_cast<std::size_t>(v)];
    const auto id_at = [&](std::size_t i) { return id[static_cast<std::size_t>(point_of[i])]; };
    sights[static_cast<std::size_t>(v)] = sights_of(point_of, 1, id_at, [](std::int32_t) { return kVoid; });
  });
  return sights;
}

}  // namespace semfield
