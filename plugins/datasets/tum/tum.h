// Recordings in the layout of the TUM RGB-D benchmark: rgb.txt, depth.txt and groundtruth.txt with times, and the
// images that they name.
#pragma once

#include <string>
#include <vector>

#include "loading/posed_photographs.h"

namespace semfield {

struct TumParams : PhotographParams {
  std::vector<double> lens;  ///< fx fy cx cy, or these and k1 k2 p1 p2 k3; empty: by the name of the folder
  double within_s = 0.02;
  double depth_steps = 5000;  ///< of a depth image, per metre
};
void describe(ParamVisitor& visit, TumParams& params);
void validate(const TumParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, TumParams& params);

class Tum final : public PhotographDataset<TumParams> {
 public:
  using PhotographDataset::PhotographDataset;
  SceneInfo open(Diagnostics& diagnostics) override;
};

}  // namespace semfield
