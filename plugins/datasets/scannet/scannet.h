// Exported ScanNet scenes: color/, depth/, pose/, intrinsic/, label-filt/, instance-filt/.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "loading/frame_files.h"
#include "plugin/dataset.h"
#include "scene/classes/class_table.h"

namespace semfield {

SEMFIELD_CHOICES(ScannetIds, "raw", "nyu40", "eigen13");

struct ScannetParams {
  std::string root;
  ScannetIds class_ids = ScannetIds::nyu40;
  std::string classes;
  std::string label_dir = "label-filt";
  std::int32_t max_frames = 300;
  std::int32_t test_every = 2;
  UnknownLabels unknown_labels = UnknownLabels::error;
  MissingFiles missing = MissingFiles::error;
};
void describe(ParamVisitor& visit, ScannetParams& params);
void validate(const ScannetParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, ScannetParams& params);

/// A frame is delivered by the colour camera, at its size. Depth is looked up at the depth camera's pixel that the
/// colour pixel's ray falls into (both look from the pose, so z-depth is the same), labels and instances, which stand
/// for the colour picture at whatever size, at the nearest pixel.
class Scannet final : public Dataset {
 public:
  Scannet(const ScannetParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override;

 private:
  struct View {
    int number = 0;  ///< <id> of color/<id>.jpg
    std::string color;
    Pose pose;
  };
  std::vector<View> list_views(FrameFileCheck& check, Diagnostics& diagnostics) const;
  Camera read_camera(const std::string& file, const std::vector<std::string>& images, Diagnostics& diagnostics) const;
  void check_extrinsics(Diagnostics& diagnostics) const;
  void add_frame(const View& view, std::size_t rank, std::size_t views, FrameFileCheck& check,
                 Diagnostics& diagnostics);
  void load_classes(Diagnostics& diagnostics);

  ScannetParams params_;
  std::string root_, table_file_;
  Camera color_, depth_;
  std::array<bool, 3> has_{};  ///< depth, labels, instances: the folder is there
  SceneInfo info_;
  std::vector<FrameFiles> files_;
  std::vector<std::int16_t> index_of_raw_;  ///< [65536] class index, kVoid, or kUnknown
};

}  // namespace semfield
