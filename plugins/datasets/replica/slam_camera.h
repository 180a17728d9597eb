// The camera of Replica sequences as NICE-SLAM renders them.
#pragma once

#include <string>

#include "core/error.h"
#include "scene/camera.h"

namespace semfield {

/// Whether a folder holds traj.txt and results/.
bool is_slam_sequence(const std::string& folder);

/// What cam_params.json says, which lies beside the trajectory or in the folder above.
struct SlamCamera {
  Camera camera;                     ///< width 0 where there is no such file, or one that was reported
  double depth_unit_m = 1 / 6553.5;  ///< of one step of a depth image
};
SlamCamera read_slam_camera(const std::string& folder, Diagnostics& diagnostics);

}  // namespace semfield
