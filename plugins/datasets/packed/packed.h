// Packed scenes: one file written by `semfield pack`; needs no image library.
#pragma once

#include <optional>
#include <string>

#include "config/params.h"
#include "loading/packed_scene.h"
#include "plugin/dataset.h"

namespace semfield {

struct PackedParams {
  std::string file;
};
void describe(ParamVisitor& visit, PackedParams& params);
void validate(const PackedParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, PackedParams& params);

class Packed final : public Dataset {
 public:
  Packed(const PackedParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override;

 private:
  std::string path_;
  std::optional<PackedScene> scene_;
};

}  // namespace semfield
