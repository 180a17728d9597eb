// How the cameras of a scene stand to what they photograph, conventions of their poses, and a plain background behind
// an object.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "core/small_math.h"
#include "scene/scene.h"

namespace semfield {

/// Of the turn from one camera to the other, 0 to 180 degrees.
double angle_deg(const Pose& a, const Pose& b);

using Cameras = std::vector<const FrameInfo*>;

struct CameraRig {
  /// The cameras stand around one place that nearly all of them see, over about half a circle at least. False for
  /// walks, panoramas and views from one side.
  bool inward = false;
  /// Forward-facing: the cameras stand beside one another and look the same way, within about 30 degrees. False for a
  /// walk ahead. Told of cameras with depth too.
  bool forward = false;
  Vec3d focus;            ///< nearest to all view axes; meaningful where inward, as the rest
  double distance_m = 0;  ///< of the cameras to the focus, median
  Box seen;               ///< of what nine in ten cameras see together, between them
};

/// From poses and lenses alone.
CameraRig find_rig(const Cameras& cameras);

/// CameraRig::forward alone.
bool look_one_way(const Cameras& cameras);

// What the user says of a scene whose files keep another convention than its dataset expects, and how poses and depth
// are brought right by it.

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

// Frames of an object before one colour: a transparent or plain background, and the box of what stands before it.

struct PlainBackground {
  std::array<std::uint8_t, 3> color{};
  Box object;  ///< of the visual hull: of the voxels that hardly any frame shows as background
};

/// What the frames' borders show alike, when that is a quarter of all pixels too; nothing unless the cameras look
/// inward. `cameras[i]` took `pixels[i]`. Transparent pixels have the colour that the dataset put behind them.
std::optional<PlainBackground> find_plain_background(const Cameras& cameras,
                                                     const std::vector<const StoredFrame*>& pixels,
                                                     const CameraRig& rig);

// Which way is up, as cameras show it.

/// The mean of the cameras' up vectors as a unit vector; the axis of the world that it lies within 20 degrees of, where
/// there is one. Nothing where they cancel.
std::optional<Vec3d> up_of_cameras(std::span<const Pose> world_from_camera);

/// x, y, z or one of them with a sign before it; nothing for anything else.
std::optional<Vec3d> axis_named(const std::string& name);
/// "+z", or the numbers of a direction that is no axis.
std::string axis_text(Vec3d up);

}  // namespace semfield
