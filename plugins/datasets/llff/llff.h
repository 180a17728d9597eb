// LLFF scenes: poses_bounds.npy and a folder of images in the order of their names.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "loading/posed_photographs.h"
#include "plugin/dataset.h"

namespace semfield {

struct LlffParams {
  std::string root;
  std::string images = "images";
  std::int32_t test_every = 8;
  std::string label_dir;
  std::string classes;
  UnknownLabels unknown_labels = UnknownLabels::error;
  std::string masks;
};
void describe(ParamVisitor& visit, LlffParams& params);
void validate(const LlffParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, LlffParams& params);

class Llff final : public Dataset {
 public:
  Llff(const LlffParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override { files_.read(frame, out); }

 private:
  LlffParams params_;
  PosedPhotographs files_;
};

}  // namespace semfield
