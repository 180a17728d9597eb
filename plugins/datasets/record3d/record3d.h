// Exports of Record3D from a phone with LiDAR: rgb/, depth/ and metadata.json.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "loading/frame_files.h"
#include "plugin/dataset.h"

namespace semfield {

struct Record3dParams {
  std::string root;
  std::int32_t test_every = 8;
  std::string label_dir;
  std::string classes;
  UnknownLabels unknown_labels = UnknownLabels::error;
  MissingFiles missing = MissingFiles::error;
};
void describe(ParamVisitor& visit, Record3dParams& params);
void validate(const Record3dParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, Record3dParams& params);

/// A frame has the size of its photograph. Its depth, of whatever size, covers the same picture and is read at the
/// nearest pixel: an average across an edge would be a surface that is not there.
class Record3d final : public Dataset {
 public:
  Record3d(const Record3dParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override;

 private:
  /// What metadata.json tells.
  struct Recording {
    Camera camera;                             ///< of all frames, at the size that the file states
    std::vector<std::array<double, 4>> lens;   ///< fx, fy, cx, cy of each frame; empty where the file has none
    std::vector<std::array<double, 7>> poses;  ///< of each frame: quaternion x, y, z, w, and centre
  };
  static Recording read_recording(const std::string& path, Diagnostics& diagnostics);
  void add_frame(FrameInfo frame, const FrameFiles& files, FrameFileCheck& check, Diagnostics& diagnostics);

  Record3dParams params_;
  std::string root_, class_file_;
  SceneInfo info_;
  std::vector<FrameFiles> files_;
};

}  // namespace semfield
