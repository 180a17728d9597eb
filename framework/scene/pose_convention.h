// What the user says of a scene whose files keep another convention than its dataset expects, and how poses and depth
// are brought right by it.
#pragma once

#include "scene/scene.h"

namespace semfield {

/// Keys of `scene.load`; all of them together make the matrices of the files camera-to-world, in the axes and the unit
/// of the depth.
struct PoseConvention {
  bool flip_camera_axes = false;
  bool invert_poses = false;
  double pose_scale = 1;
  double depth_scale = 1;
  bool operator==(const PoseConvention&) const = default;
};

/// world_from_camera in OpenCV axes from what open() made of a file's matrix. `opengl_files` as in SceneInfo: the
/// matrix is inverted in the axes of the file.
Pose converted_pose(const Pose& pose, const PoseConvention& convention, bool opengl_files);

/// Poses, bounds, near and far of a manifest. Bounds follow a scale; what an inversion moves, and distances that depth
/// can tell, are left to be derived. A converted manifest is in house conventions.
void convert_info(SceneInfo& info, const PoseConvention& convention);

/// Depth of a frame as read.
void convert_depth(FrameBuffer& frame, const PoseConvention& convention);

}  // namespace semfield
