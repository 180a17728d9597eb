// How the cameras of a scene stand to what they photograph: around one place, or any other way.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "scene/scene.h"

namespace semfield {

using Cameras = std::vector<const FrameInfo*>;

struct CameraRig {
  /// The cameras stand around one place that nearly all of them see, over about half a circle at least. False for
  /// walks, panoramas and views from one side.
  bool inward = false;
  Vec3d focus;            ///< nearest to all view axes; meaningful where inward, as the rest
  double distance_m = 0;  ///< of the cameras to the focus, median
  Box seen;               ///< of what nine in ten cameras see together, between them
};

/// From poses and lenses alone.
CameraRig find_rig(const Cameras& cameras);

/// At most `most` of them, evenly taken.
Cameras some_of(const Cameras& cameras, std::size_t most);

/// Where a world point falls in the frame's image, pixels; false when it is behind the camera or beside the image.
bool project_into(const FrameInfo& frame, Vec3d point, double& u, double& v);

/// Box of the voxels of `region`, 48 an axis, whose centres `keeps` accepts (called from any thread); empty when there
/// is none.
Box box_of_voxels(const Box& region, const std::function<bool(Vec3d center)>& keeps);

}  // namespace semfield
