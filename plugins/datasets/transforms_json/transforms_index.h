// The text of transforms.json files as plain structs; the only place of this plugin that knows JSON.
#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include "core/error.h"
#include "loading/frame_files.h"
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

}  // namespace semfield
