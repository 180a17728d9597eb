// A scene whose cameras were fixed, written as a transforms.json of its own.
#pragma once

#include <string>

#include "loading/capture/fix_cameras.h"

namespace semfield::app {

/// Writes images/, depth/, label/, instance/, mask/, classes.yaml and, last, transforms.json into `folder`. Photographs
/// are copied as they are where they are files; depth keeps its own camera where that is another ("depth_camera").
/// Frames keep names and splits.
void write_fixed_scene(const PosedScene& scene, const FixedCameras& cameras, const std::string& folder,
                       const CaptureProgress& progress);

}  // namespace semfield::app
