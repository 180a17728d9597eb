#include "app/render/render_views.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "scene/camera_path.h"
#include "scene/output_names.h"

namespace semfield::app {

namespace {

constexpr int kFramesPerKey = 36;  // of a smooth path: a training camera every one and a half seconds

NamedView view_of(const Session& s, int frame) {
  const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(frame)];
  return {info.name, {info.camera, info.world_from_camera, s.plan.undistortion}, s.limits, frame};
}

std::vector<NamedView> views_of_poses(const Session& s, const std::vector<Pose>& poses) {
  const Camera& camera = s.scene.info.frames.front().camera;
  std::vector<NamedView> views;
  for (const Pose& pose : poses)
    views.push_back({fmt::format("{:05}", views.size()), {camera, pose, s.plan.undistortion}, s.limits});
  return views;
}

// Each with its own lens and limits; bounds are the run's.
std::vector<NamedView> views_of_cameras(const Session& s, const CameraSet& set) {
  std::vector<NamedView> views;
  for (const PlacedCamera& placed : set.cameras) {
    NamedView view{placed.name, {placed.camera, placed.world_from_camera, placed.camera.has_distortion()}, s.limits};
    if (placed.far_m > 0) {
      view.limits.near_m = placed.near_m;
      view.limits.far_m = placed.far_m;
      view.limits.z_depth = set.z_depth;
    }
    views.push_back(std::move(view));
  }
  return views;
}

std::vector<Pose> smooth_path(const Session& s, int frames) {
  std::vector<Pose> keys;
  for (const int f : evenly_spaced(s.scene.frames_of(Split::train), 2 + frames / kFramesPerKey)) {
    keys.push_back(s.scene.info.frames[static_cast<std::size_t>(f)].world_from_camera);
  }
  return keys.empty() ? keys : make_smooth_path(keys, frames);
}

}  // namespace

std::string NamedView::file_name() const { return output_name(name); }

std::string render_name(const RenderOptions& options) {
  if (options.trajectory.empty()) return options.split;
  return options.trajectory == "smooth" ? "smooth" : "trajectory";
}

std::vector<NamedView> render_views(const Session& s, const RenderOptions& options, Diagnostics& diagnostics) {
  std::vector<NamedView> views;
  if (options.trajectory == "smooth") {
    views = views_of_poses(s, smooth_path(s, options.frames));
  } else if (!options.trajectory.empty() && is_camera_set(options.trajectory)) {
    views = views_of_cameras(s, read_cameras(options.trajectory, diagnostics));
  } else if (!options.trajectory.empty()) {
    views = views_of_poses(s, read_camera_file(options.trajectory, CameraAxes::right_down_forward));
  } else {
    for (const int f : s.scene.frames_of(options.split == "test" ? Split::test : Split::train)) {
      views.push_back(view_of(s, f));
    }
  }
  if (views.empty()) {
    throw Error(ErrorKind::data, "scene.split.empty",
                options.run + ": nothing to render in '" + render_name(options) + "'", "see `semfield inspect`");
  }
  for (NamedView& view : views) {
    Camera& camera = view.camera.camera;
    const double height = static_cast<double>(options.width) * camera.height_px / camera.width_px;
    if (options.width > 0)
      camera = camera.resized(options.width, static_cast<std::int32_t>(std::max(1L, std::lround(height))));
  }
  return views;
}

CameraSet cameras_of(const std::vector<NamedView>& views) {
  CameraSet set;
  set.z_depth = views.front().limits.z_depth;
  for (const NamedView& view : views) {
    set.cameras.push_back(
        {view.name, view.camera.camera, view.camera.world_from_camera, view.limits.near_m, view.limits.far_m});
  }
  return set;
}

}  // namespace semfield::app
