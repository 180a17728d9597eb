// What a scene decides of corrections of its cameras, where the configuration leaves it open.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "session/settings/run_config.h"

namespace semfield {

struct CameraEvidence {
  bool tracked = false;            ///< SceneInfo::tracked
  std::optional<double> exposure;  ///< LoadedScene::exposure
  std::optional<bool> fits = {};   ///< the photographs, by LoadedScene::cameras; nothing: they say nothing
};

/// Brightness of overlapping frames that differs by more than this factor is a camera's that changes its exposure.
/// Renderings differ by 1.001, photographs with a fixed exposure by 1.003 to 1.02, the HoloLens room by 1.12 (decision
/// 40).
inline constexpr double kExposureChanges = 1.05;

/// Why `auto` became what it did; empty where it was not asked for.
struct CameraReasons {
  std::string poses, colors;
  std::vector<std::string> learned;  ///< a line for each that is learned, which no list of parts left out has
};

/// Puts what `auto` is in place of it. Poses: learned where a phone's tracker gave them and photographs do not say that
/// they fit; far wrong ones are for `prepare` to fix. Colours: learned where brightness changes.
CameraReasons choose_cameras(CameraParams& cameras, const CameraEvidence& evidence);

}  // namespace semfield
