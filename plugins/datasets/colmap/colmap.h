// COLMAP sparse models with their images; label images beside them where there are any.
#pragma once

#include <string>

#include "config/params.h"
#include "loading/colmap_model.h"
#include "loading/posed_photographs.h"

namespace semfield {

/// Its keys are those of PhotographParams but `every` and `least_confidence`.
struct ColmapParams : PhotographParams {
  std::string model, images = "images";
};
void describe(ParamVisitor& visit, ColmapParams& params);
std::string recognise(const std::string& path, ColmapParams& params);
std::string preparation(const std::string& folder, const ColmapParams& params);

class Colmap final : public PhotographDataset<ColmapParams> {
 public:
  using PhotographDataset::PhotographDataset;
  SceneInfo open(Diagnostics& diagnostics) override;

 private:
  std::string model_folder(Diagnostics& diagnostics) const;
};

}  // namespace semfield
