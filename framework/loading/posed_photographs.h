// What a dataset of photographs with poses does whatever its files look like: checks, splits, labels, masks, and depth
// of another size with its confidence. Exports of scanning apps are such datasets.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "loading/frame_files.h"
#include "scene/scene.h"

namespace semfield {

/// As ARKit rates a depth.
enum class Confidence : std::uint8_t { low, medium, high };
template <>
struct ChoiceNames<Confidence> {
  static constexpr std::array<std::string_view, 3> names{"low", "medium", "high"};
};

struct PhotographParams {
  std::string root;
  std::int32_t every = 1;
  std::int32_t test_every = 8;
  Confidence least_confidence = Confidence::medium;
  std::string label_dir;
  std::string classes;
  std::string masks;
  UnknownLabels unknown_labels = UnknownLabels::error;
  MissingFiles missing = MissingFiles::error;
};
void describe(ParamVisitor& visit, PhotographParams& params);
void validate(const PhotographParams& params, Diagnostics& diagnostics);

/// A photograph, as a reader finds it.
struct PosedPhotograph {
  std::string image, depth;  ///< depth: "" where there is none
  std::string confidence;    ///< 8-bit, as large as the depth: 0 low, `high` high, anything between medium; "" for none
  int high = 2;
  double depth_unit_m = 0.001;  ///< of one step of the depth image
  Camera camera;                ///< of images of the size that the files state
  Pose world_from_camera;       ///< OpenCV axes, metres
};

/// Sets the size of a camera to numbers of a file; false (reported under `place`) unless they are whole numbers of
/// pixels.
bool set_image_size(Camera& camera, double width, double height, const std::string& place, Diagnostics& diagnostics);

/// The frames of a folder. A frame has the size of its photograph; depth covers the same picture and is read at the
/// nearest pixel, for an average across an edge would be a surface that is not there.
class PosedPhotographs {
 public:
  PosedPhotographs(const PhotographParams& params, const std::string& config_dir);
  /// Absolute, or from where the program runs.
  const std::string& root() const { return root_; }
  /// Throws Error(no_input) unless there are these folders and files in the root; says that `app` writes them.
  void require(std::initializer_list<const char*> parts, const std::string& app) const;

  /// Checks every N-th of the photographs, in their order, and makes frames of them; `opengl_files`: of SceneInfo. What
  /// is wrong with one goes into `diagnostics` under its place.
  SceneInfo open(const std::vector<PosedPhotograph>& photos, bool opengl_files, Diagnostics& diagnostics);
  /// As Dataset::read.
  void read(int frame, FrameBuffer& out) const;

 private:
  PhotographParams params_;
  std::string root_, class_file_;
  SceneInfo info_;
  std::vector<FrameFiles> files_;
  std::vector<PosedPhotograph> photos_;  ///< of each frame
};

}  // namespace semfield
