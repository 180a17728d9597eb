// Raw exports of Polycam from a phone with LiDAR: keyframes/ with images, cameras, depth and confidence.
#pragma once

#include <string>
#include <vector>

#include "loading/posed_photographs.h"
#include "plugin/dataset.h"

namespace semfield {

struct PolycamParams : PhotographParams {};
std::string recognise(const std::string& path, PolycamParams& params);

class Polycam final : public Dataset {
 public:
  Polycam(const PolycamParams& params, const DatasetBuild& build) : files_(params, build.config_dir) {}
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override { files_.read(frame, out); }

 private:
  PosedPhotographs files_;
};

}  // namespace semfield
