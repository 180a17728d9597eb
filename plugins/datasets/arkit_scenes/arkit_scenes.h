// Scenes of Apple's ARKitScenes: lowres_wide/ with a trajectory, intrinsics, depth and confidence.
#pragma once

#include <string>
#include <vector>

#include "loading/posed_photographs.h"
#include "plugin/dataset.h"

namespace semfield {

struct ArkitScenesParams : PhotographParams {};
std::string recognise(const std::string& path, ArkitScenesParams& params);

class ArkitScenes final : public Dataset {
 public:
  ArkitScenes(const ArkitScenesParams& params, const DatasetBuild& build) : files_(params, build.config_dir) {}
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override { files_.read(frame, out); }

 private:
  PosedPhotographs files_;
};

}  // namespace semfield
