// Exports of Record3D from a phone with LiDAR: rgb/, depth/ and metadata.json.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "loading/posed_photographs.h"

namespace semfield {

struct Record3dParams : PhotographParams {};
std::string recognise(const std::string& path, Record3dParams& params);

class Record3d final : public PhotographDataset<Record3dParams> {
 public:
  using PhotographDataset::PhotographDataset;
  SceneInfo open(Diagnostics& diagnostics) override;

 private:
  /// What metadata.json tells.
  struct Recording {
    Camera camera;                             ///< of all frames, at the size that the file states
    std::vector<std::array<double, 4>> lens;   ///< fx, fy, cx, cy of each frame; empty where the file has none
    std::vector<std::array<double, 7>> poses;  ///< of each frame: quaternion x, y, z, w, and centre
  };
  static Recording read_recording(const std::string& path, Diagnostics& diagnostics);
};

}  // namespace semfield
