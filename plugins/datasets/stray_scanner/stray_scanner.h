// Recordings of Stray Scanner from a phone with LiDAR: odometry.csv, camera_matrix.csv, rgb/, depth/, confidence/.
#pragma once

#include <string>
#include <vector>

#include "loading/posed_photographs.h"
#include "plugin/dataset.h"

namespace semfield {

struct StrayScannerParams : PhotographParams {};
std::string recognise(const std::string& path, StrayScannerParams& params);

class StrayScanner final : public Dataset {
 public:
  StrayScanner(const StrayScannerParams& params, const DatasetBuild& build) : files_(params, build.config_dir) {}
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override { files_.read(frame, out); }

 private:
  PosedPhotographs files_;
};

}  // namespace semfield
