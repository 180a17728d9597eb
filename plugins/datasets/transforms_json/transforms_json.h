// transforms.json scenes of nerfstudio, instant-ngp and Blender.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "loading/frame_files.h"
#include "plugin/dataset.h"
#include "scene/scene.h"

namespace semfield {

/// Intrinsics as written; a frame's own values override the file's. Image size 0 where only the image can tell.
struct TransformsLens {
  double w = 0, h = 0, fl_x = 0, fl_y = 0, camera_angle_x = 0, camera_angle_y = 0;
  std::optional<double> cx, cy;
  double k1 = 0, k2 = 0, k3 = 0, k4 = 0, p1 = 0, p2 = 0;
  LensKind kind = LensKind::perspective;
};

struct TransformsFrame {
  std::string place;      ///< "transforms.json: frame 3 (images/0003.jpg)"
  std::string file_path;  ///< as written
  FrameFiles files;       ///< resolved; colour with its extension found
  TransformsLens lens;
  std::vector<double> matrix;  ///< 16 numbers, row-major; empty when the file's was unusable (already reported)
  std::optional<Split> split;  ///< told by the file (Blender's file names, nerfstudio's *_filenames)
  std::map<std::string, std::string> channels;  ///< name to file, of those that it has
  double depth_unit_m = 0;                      ///< of one step of its depth image; 0 = not told
};

struct TransformsIndex {
  std::vector<TransformsFrame> frames;
  bool metric = false;            ///< its poses are in metres
  std::string unclear_depth_key;  ///< a key that tells a unit of depth in a way that is not known; "" = none
  Box limit;                      ///< instant-ngp's box of side aabb_scale in the poses' axes; empty = not told
  /// Of the camera that took the depth images, where it is another: its lens, and depth_from_color [4][4] by rows.
  std::optional<TransformsLens> depth_lens;
  std::vector<double> depth_from_color;
  std::string classes;                 ///< path of a class table; "" = not told
  std::vector<ClassEntry> class_list;  ///< classes written in the file itself
};

/// Reads `root`/transforms.json, or transforms_train/val/test.json, or `root` itself when it is a file; without a test
/// file the validation frames are held out. `label_key` is the key of a frame that names its label image, "" for none;
/// NAME_path is that of each of `channels`.
/// Problems of single frames go into `diagnostics`; throws Error when no index is there or it is not JSON.
TransformsIndex read_transforms(const std::string& root, const std::string& label_key,
                                const std::vector<std::string>& channels, Diagnostics& diagnostics);

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
