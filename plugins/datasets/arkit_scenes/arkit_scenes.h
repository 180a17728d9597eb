// Scenes of Apple's ARKitScenes: lowres_wide/ with a trajectory, intrinsics, depth and confidence.
#pragma once

#include <string>

#include "loading/posed_photographs.h"

namespace semfield {

struct ArkitScenesParams : PhotographParams {};
std::string recognise(const std::string& path, ArkitScenesParams& params);

class ArkitScenes final : public PhotographDataset<ArkitScenesParams> {
 public:
  using PhotographDataset::PhotographDataset;
  SceneInfo open(Diagnostics& diagnostics) override;
};

}  // namespace semfield
