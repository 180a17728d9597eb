// COLMAP sparse models with their images; label images beside them where there are any.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "loading/colmap_model.h"
#include "loading/posed_photographs.h"
#include "plugin/dataset.h"

namespace semfield {

struct ColmapParams {
  std::string root;
  std::string model;
  std::string images = "images";
  std::int32_t test_every = 8;
  std::string label_dir;
  std::string classes;
  UnknownLabels unknown_labels = UnknownLabels::error;
  std::string masks;
  MissingFiles missing = MissingFiles::error;
};
void describe(ParamVisitor& visit, ColmapParams& params);
void validate(const ColmapParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, ColmapParams& params);
std::string preparation(const std::string& folder, const ColmapParams& params);

class Colmap final : public Dataset {
 public:
  Colmap(const ColmapParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override { files_.read(frame, out); }

 private:
  std::string model_folder(Diagnostics& diagnostics) const;

  ColmapParams params_;
  PosedPhotographs files_;
};

}  // namespace semfield
