// What a scene holds, as text and as JSON, and its cameras as a mesh.
#pragma once

#include <string>

#include "app/json_output.h"
#include "core/error.h"
#include "loading/frame_source.h"

namespace semfield {

/// Frames, splits, sizes, extent, bounds, near and far, class table with pixel fractions of train and test and how many
/// labelled training frames see each class, then every problem with its remedy. `depth_use`: what training makes of
/// depth images (session/settings/loss_config.h). Ends with a line feed.
std::string inspect_report(const LoadedScene& scene, const Diagnostics& diagnostics, const std::string& depth_use = "");
/// The same for programs.
app::Json inspect_json(const LoadedScene& scene, const Diagnostics& diagnostics, const std::string& depth_use = "");

/// Camera frusta as binary PLY: a pyramid per frame of `depth_m` height (0 = 2 % of the bounds' diagonal), train blue,
/// test orange.
void write_frusta_ply(const std::string& path, const LoadedScene& scene, double depth_m = 0);

}  // namespace semfield
