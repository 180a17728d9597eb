// Poses and depth of files that keep another convention than their dataset expects.
#include "scene/pose_convention.h"

#include <algorithm>

#include "scene/scene_checks.h"

namespace semfield {

namespace {

Pose inverse(const Pose& pose) {
  Pose out;
  for (std::size_t row = 0; row < 3; ++row) {
    for (std::size_t col = 0; col < 3; ++col) out.r[row][col] = pose.r[col][row];
  }
  out.t = pose.unrotate(pose.t) * -1.0;
  return out;
}

}  // namespace

Pose converted_pose(const Pose& pose, const PoseConvention& convention, bool opengl_files) {
  Pose out = pose;
  if (convention.invert_poses) out = inverse(opengl_files ? opencv_from_opengl(pose) : pose);  // the file's own matrix
  // The axes of the file are turned unless they are OpenCV's; without an inversion open() has already done so.
  const bool turn = convention.invert_poses ? opengl_files != convention.flip_camera_axes : convention.flip_camera_axes;
  if (turn) out = opencv_from_opengl(out);
  out.t = out.t * convention.pose_scale;
  return out;
}

void convert_info(SceneInfo& info, const PoseConvention& convention) {
  if (convention == PoseConvention{}) return;
  for (FrameInfo& frame : info.frames)
    frame.world_from_camera = converted_pose(frame.world_from_camera, convention, info.opengl_files);
  info.opengl_files = false;
  if (convention.invert_poses) {
    info.bounds = info.limit = Box{};
    info.near_hint_m = info.far_hint_m = 0;
  } else if (convention.pose_scale != 1) {
    for (Box* box : {&info.bounds, &info.limit}) {
      if (box->empty()) continue;
      box->lo = box->lo * convention.pose_scale;
      box->hi = box->hi * convention.pose_scale;
    }
    // Where poses and depth were in two units, it is not known in which of them the hints were; depth tells.
    const bool depth =
        convention.depth_scale != convention.pose_scale &&
        std::any_of(info.frames.begin(), info.frames.end(), [](const FrameInfo& f) { return f.has_depth; });
    info.near_hint_m = depth ? 0 : info.near_hint_m * convention.pose_scale;
    info.far_hint_m = depth ? 0 : info.far_hint_m * convention.pose_scale;
  }
}

void convert_depth(FrameBuffer& frame, const PoseConvention& convention) {
  if (convention.depth_scale == 1) return;
  for (float& depth : frame.depth_m) depth = static_cast<float>(depth * convention.depth_scale);
}

}  // namespace semfield
