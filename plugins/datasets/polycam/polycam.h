// Raw exports of Polycam from a phone with LiDAR: keyframes/ with images, cameras, depth and confidence.
#pragma once

#include <string>

#include "loading/posed_photographs.h"

namespace semfield {

struct PolycamParams : PhotographParams {};
std::string recognise(const std::string& path, PolycamParams& params);

class Polycam final : public PhotographDataset<PolycamParams> {
 public:
  using PhotographDataset::PhotographDataset;
  SceneInfo open(Diagnostics& diagnostics) override;
};

}  // namespace semfield
