// LLFF scenes: poses_bounds.npy and a folder of images in the order of their names.
#pragma once

#include <string>

#include "config/params.h"
#include "loading/posed_photographs.h"

namespace semfield {

/// Its keys are those of PhotographParams but `every`, `least_confidence` and `missing`.
struct LlffParams : PhotographParams {
  std::string images = "images";
};
void describe(ParamVisitor& visit, LlffParams& params);
std::string recognise(const std::string& path, LlffParams& params);

class Llff final : public PhotographDataset<LlffParams> {
 public:
  using PhotographDataset::PhotographDataset;
  SceneInfo open(Diagnostics& diagnostics) override;
};

}  // namespace semfield
