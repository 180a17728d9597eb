#include "app/render/render_views.h"

#include <fmt/format.h>

#include <algorithm>

#include "scene/camera_path.h"

namespace semfield::app {

namespace {

constexpr int kFramesPerKey = 36;  // of a smooth path: a training camera every one and a half seconds

NamedView view_of(const Session& s, const FrameInfo& info) {
  return {info.name, {info.camera, info.world_from_camera, s.plan.undistortion}};
}

std::vector<NamedView> views_of_poses(const Session& s, const std::vector<Pose>& poses) {
  const Camera& camera = s.scene.info.frames.front().camera;
  std::vector<NamedView> views;
  for (const Pose& pose : poses)
    views.push_back({fmt::format("{:05}", views.size()), {camera, pose, s.plan.undistortion}});
  return views;
}

std::vector<Pose> smooth_path(const Session& s, int frames) {
  if (frames < 1 || frames > 100000) {
    throw Error(ErrorKind::usage, fmt::format("--frames {}: expected 1 to 100000", frames));
  }
  std::vector<Pose> keys;
  for (const int f : evenly_spaced(s.scene.frames_of(Split::train), 2 + frames / kFramesPerKey)) {
    keys.push_back(s.scene.info.frames[static_cast<std::size_t>(f)].world_from_camera);
  }
  return keys.empty() ? keys : make_smooth_path(keys, frames);
}

}  // namespace

std::string render_name(const RenderOptions& options) {
  if (options.trajectory.empty()) return options.split;
  return options.trajectory == "smooth" ? "smooth" : "trajectory";
}

std::vector<NamedView> render_views(const Session& s, const RenderOptions& options) {
  std::vector<NamedView> views;
  if (options.trajectory == "smooth") {
    views = views_of_poses(s, smooth_path(s, options.frames));
  } else if (!options.trajectory.empty()) {
    views = views_of_poses(s, read_camera_file(options.trajectory, CameraAxes::right_down_forward));
  } else {
    if (options.split != "test" && options.split != "train")
      throw Error(ErrorKind::usage, "--split " + options.split + ": expected train or test");
    for (const int f : s.scene.frames_of(options.split == "test" ? Split::test : Split::train)) {
      views.push_back(view_of(s, s.scene.info.frames[static_cast<std::size_t>(f)]));
    }
  }
  if (views.empty()) {
    throw Error(ErrorKind::data, options.run + ": nothing to render in '" + render_name(options) + "'",
                "see `semfield inspect`");
  }
  return views;
}

}  // namespace semfield::app
