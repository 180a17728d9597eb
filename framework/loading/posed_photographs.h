// What a dataset of photographs with poses does whatever its files look like: checks, splits, labels, masks, and depth
// of another size with its confidence. Exports of scanning apps are such datasets.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "formats/image_io.h"
#include "loading/frame_files.h"
#include "loading/frame_source.h"
#include "scene/dataset.h"
#include "scene/scene.h"

namespace semfield {

/// As ARKit rates a depth.
enum class Confidence : std::uint8_t { low, medium, high };
SEMFIELD_CHOICES(Confidence, "low", "medium", "high");

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
  std::string name = {};     ///< below the folder of images, where label images lie as these do; "": the file's
  std::string place = {};    ///< of the pose, for messages; "": the frame
  /// 8-bit, as large as the depth: 0 low, `high` high, anything between medium; "" for none.
  std::string confidence = {};
  int high = 2;
  double depth_unit_m = 0.001;  ///< of one step of the depth image
  Camera camera;                ///< of images of the size that the files state
  bool fitted = false;          ///< to these images: its centre may lie anywhere
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
  /// is wrong with one goes into `diagnostics` under its place; what is wrong with the poses of all under `poses`,
  /// where they are from; "": the folder.
  SceneInfo open(const std::vector<PosedPhotograph>& photos, bool opengl_files, Diagnostics& diagnostics,
                 const std::string& poses = "");
  /// As Dataset::read.
  void read(int frame, FrameBuffer& out) const;

 private:
  PhotographParams params_;
  std::string root_, class_file_;
  SceneInfo info_;
  std::vector<FrameFiles> files_;
  std::vector<PosedPhotograph> photos_;  ///< of each frame
};

/// A dataset whose frames are such photographs; `Params` begin with PhotographParams. Its plugin writes
///   SceneInfo find_photographs(const Params& params, PosedPhotographs& files, Diagnostics& diagnostics);
/// which finds the photographs below files.root() and gives them to files.open().
template <class Params>
class PhotographDataset final : public Dataset {
 public:
  PhotographDataset(const Params& params, const DatasetBuild& build)
      : params_(params), files_(params, build.config_dir) {}
  SceneInfo open(Diagnostics& diagnostics) override { return find_photographs(params_, files_, diagnostics); }
  void read(int frame, FrameBuffer& out) const override { files_.read(frame, out); }

 private:
  Params params_;
  PosedPhotographs files_;
};

// Whether the camera of a frame is that of its image: the size that it states against the size of the file.

/// What "colour image" is called in messages; other channels of a frame are others.
inline constexpr const char* kColorImage = "colour image";

/// What is wrong between an image of a frame and a camera of another size, and what to do. Of a colour image it says by
/// which factor the intrinsics are off, or that it is turned by a quarter, by its EXIF orientation where that says so.
struct OtherSize {
  Code code;
  std::string message, remedy;
};
OtherSize other_size(std::string_view what, const std::string& path, const ImageSize& size, const Camera& camera);

/// Cameras of images that are scaled copies of those that they were made from: intrinsics follow the ratio of sizes.
class CameraFit {
 public:
  /// Brings `camera` to the size of the file, where both are of one shape but for a rounded side. False when it
  /// reported that they are not. A file that cannot be read is left to FrameFileCheck.
  bool fit(const std::string& image, const std::string& place, Camera& camera, Diagnostics& diagnostics);
  /// After the last frame: a note under `source` of the cameras that were scaled.
  void report(const std::string& source, Diagnostics& diagnostics) const;

 private:
  struct Scaled {
    std::string text;
    std::size_t frames = 0;
  };
  std::map<std::string, Scaled> scaled_;  // factor -> what of the first frame
};

}  // namespace semfield
