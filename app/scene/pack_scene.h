// A dataset written as one packed scene.
#pragma once

#include <cstdint>
#include <string>

#include "loading/frame_source.h"
#include "loading/packed_scene.h"
#include "plugin/dataset.h"

namespace semfield {

struct PackSummary {
  int frames = 0;
  std::uint64_t bytes = 0;
};

/// Opens `dataset`, checks it (throws Error listing every problem), and writes its frames at the size that `size`
/// states for, one at a time. Bounds, near and far of `size` and of the dataset go into the manifest as they are;
/// nothing is derived.
PackSummary pack_scene(Dataset& dataset, const std::string& path, const SceneLoadOptions& size,
                       const PackOptions& options, Diagnostics& diagnostics);

}  // namespace semfield
