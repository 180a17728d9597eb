#include "session/settings/camera_choices.h"

#include <fmt/format.h>

namespace semfield {

CameraReasons choose_cameras(CameraParams& cameras, const CameraEvidence& evidence) {
  CameraReasons why;
  if (cameras.poses == CameraTrust::automatic) {
    const bool fits = evidence.fits.value_or(false);
    cameras.poses = evidence.tracked && !fits ? CameraTrust::learned : CameraTrust::given;
    why.poses = !evidence.tracked ? "poses are not those of a phone's tracker"
                : fits            ? "poses are a phone's, and the photographs fit them"
                                  : "poses are a phone's, whose tracker drifts";
  }
  if (cameras.colors == CameraTrust::automatic) {
    const bool changes = evidence.exposure && *evidence.exposure > kExposureChanges;
    cameras.colors = changes ? CameraTrust::learned : CameraTrust::given;
    why.colors = evidence.exposure ? fmt::format(
                                         "overlapping frames differ in brightness by a factor of {:.3f}, and "
                                         "more than {:g} is a camera that changes its exposure",
                                         *evidence.exposure, kExposureChanges)
                                   : "too few overlapping frames could be compared in brightness";
  }
  if (!why.poses.empty() && cameras.poses == CameraTrust::learned)
    why.learned.push_back("train.cameras.poses: learned, because " + why.poses);
  if (!why.colors.empty() && cameras.colors == CameraTrust::learned)
    why.learned.push_back("train.cameras.colors: learned, because " + why.colors);
  return why;
}

}  // namespace semfield
