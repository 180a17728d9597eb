// Cameras as a file: what `render` rendered, and what it can render again.
#pragma once

#include <span>
#include <string>
#include <vector>

#include "core/error.h"
#include "scene/camera.h"

namespace semfield {

/// A camera at a place, with the limits of its rays.
struct PlacedCamera {
  std::string name;  ///< of its images
  Camera camera;
  Pose world_from_camera;
  double near_m = 0, far_m = 0;  ///< both 0: not told
};

/// Of one file. `z_depth`: near and far are z-depths; false: distances along the ray. `depth_step`: of the depth
/// pictures beside the file, in units of the scene; 0: there are none. It is written and not read.
struct CameraSet {
  std::vector<PlacedCamera> cameras;
  bool z_depth = false;
  double depth_step = 0;
};

/// JSON, a line a camera; numbers are read back to the bit.
void write_cameras(const std::string& path, const CameraSet& set);

/// Whether a file is one of JSON, not of matrices in rows (read_camera_file): it begins with a brace or a bracket.
bool is_camera_set(const std::string& path);

/// Throws Error(data) that names the file and every camera that cannot be used: keys that are missing, unknown or of
/// another kind, sizes over `limits`, lenses and poses as check_camera and check_pose refuse them, near >= far, and
/// names that are empty, hold control characters or stand twice ('/' and '_' are the same in a file's name). Warnings
/// go to the diagnostics, which must be fresh.
CameraSet read_cameras(const std::string& path, Diagnostics& diagnostics);

}  // namespace semfield
