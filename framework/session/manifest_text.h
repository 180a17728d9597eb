// What training knew of its scene, kept in checkpoints so that rendering need not read the scene's pixels again.
#pragma once

#include <optional>
#include <string>

#include "formats/safetensors.h"
#include "model/leave_out.h"

namespace semfield {

struct KnownScene {
  SceneManifest manifest;
  double pixel_footprint_m = 0;
};

/// One JSON object, the value of the metadata key `scene`.
std::string manifest_text(const KnownScene& scene);
/// None without that key (checkpoints of version 0.1.0). Throws Error(data) when it cannot be read.
std::optional<KnownScene> read_manifest_text(const TensorMetadata& metadata);

}  // namespace semfield
