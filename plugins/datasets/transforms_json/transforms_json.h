// transforms.json scenes of nerfstudio, instant-ngp and Blender.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "config/params.h"
#include "datasets/transforms_json/transforms_index.h"
#include "loading/frame_files.h"
#include "plugin/dataset.h"

namespace semfield {

struct TransformsJsonParams {
  std::string root;
  std::int32_t test_every = 8;
  std::string label_key = "label_path";
  std::string classes;
  UnknownLabels unknown_labels = UnknownLabels::error;
  MissingFiles missing = MissingFiles::error;
  double depth_unit_m = 0;
  std::int32_t alpha_background = 255;
  bool alpha_masks = false;
  std::string masks;
  bool metric = false;
  std::vector<std::string> channels;
};
void describe(ParamVisitor& visit, TransformsJsonParams& params);
void validate(const TransformsJsonParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, TransformsJsonParams& params);

class TransformsJson final : public Dataset {
 public:
  TransformsJson(const TransformsJsonParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override;

 private:
  std::vector<const TransformsFrame*> used_frames(const TransformsIndex& index, Diagnostics& diagnostics) const;
  std::vector<Split> splits_of(const std::vector<const TransformsFrame*>& frames, Diagnostics& diagnostics) const;
  std::string folder() const;
  void read_depth_camera(const TransformsIndex& index, Diagnostics& diagnostics);
  const DepthCamera* depth_camera() const { return depth_camera_ ? &*depth_camera_ : nullptr; }
  void load_classes(const TransformsIndex& index, bool has_labels, Diagnostics& diagnostics);
  TransformsJsonParams params_;
  std::string root_, class_file_;
  SceneInfo info_;
  std::vector<FrameFiles> files_;
  std::vector<std::map<std::string, std::string>> channels_;  // of each frame: name to file
  std::optional<DepthCamera> depth_camera_;                   // where depth is of another camera
  std::vector<double> depth_units_m_;                         // of each frame
};

}  // namespace semfield
