// Whether cameras fit the photographs, in pixels; and if not, what fits.
#pragma once

#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "scene/bundle.h"

namespace semfield {

struct CameraCheck {
  int corners = 0;   ///< found again in another frame; 0: too few to say anything
  double given = 0;  ///< share of them that lie where the cameras put them
  bool off = false;  ///< other cameras fit clearly more
  /// What fits more, and what share of the corners: "another lens (focal length 532 for 585 pixels)". Of corners that
  /// took no part in finding it.
  std::vector<std::pair<std::string, double>> fits;
};

/// Poses of the bundle's frames as they were so many frames later; empty where frames are not in order.
using DelayedPoses = std::function<std::vector<Pose>(double frames)>;

/// `bundle` holds the frames as given and tracks of two frames each, whose points do not matter, in pixels of
/// `stated`; `side_px` is the longer side of the pictures in which they were found.
CameraCheck check_cameras(Bundle bundle, double side_px, const DelayedPoses& delayed);

}  // namespace semfield
