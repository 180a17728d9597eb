// Recordings of Stray Scanner from a phone with LiDAR: odometry.csv, camera_matrix.csv, rgb/, depth/, confidence/.
#pragma once

#include <string>

#include "loading/posed_photographs.h"

namespace semfield {

struct StrayScannerParams : PhotographParams {};
std::string recognise(const std::string& path, StrayScannerParams& params);

class StrayScanner final : public PhotographDataset<StrayScannerParams> {
 public:
  using PhotographDataset::PhotographDataset;
  SceneInfo open(Diagnostics& diagnostics) override;
};

}  // namespace semfield
