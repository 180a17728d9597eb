// The frames of a dataset that is made of image files: its plugin finds the photographs and what its index says of
// each; checks, splits, labels, masks and pixels are the same for all.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <initializer_list>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "config/params.h"
#include "formats/image_io.h"
#include "scene/dataset.h"
#include "scene/loading/frame_files.h"
#include "scene/scene.h"

namespace semfield {

/// As ARKit rates a depth.
enum class Confidence : std::uint8_t { low, medium, high };
SEMFIELD_CHOICES(Confidence, "low", "medium", "high");

/// What becomes of a frame whose index names files that are not there.
enum class MissingFiles { error, skip };
SEMFIELD_CHOICES(MissingFiles, "error", "skip");

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

/// What datasets say of their parameters `missing` and `masks`.
inline constexpr const char* kMissingSentence =
    "what happens when files are missing: error, or skip: a frame without image or pose is left out, and other "
    "frames go without the channel";
inline constexpr const char* kMasksSentence =
    "folder of masks, from root: NAME.png or NAME.jpg.png for the image NAME.jpg, black (0) where a pixel is masked; "
    "masked pixels draw no rays and are in no score; empty = none";

/// What the intrinsics of a photograph are of.
enum class Intrinsics : std::uint8_t {
  stated,  ///< images of the size that the files state, of which these may be scaled copies
  fitted,  ///< the same, and made of them: the centre may lie anywhere
  exact    ///< images of this very size; the dataset has checked them
};

/// A photograph, as a reader finds it.
struct PosedPhotograph : FrameFiles {
  std::string name = {};        ///< below the folder of images, where label images lie as these do; "": the file's
  std::string place = {};       ///< of the pose, for messages; "": the frame
  std::string confidence = {};  ///< 8-bit, as large as the depth: 0 low, `high` high, anything between medium; "": none
  int high = 2;
  double depth_unit_m = 0;  ///< of one step of the depth image; 0: not told, which is 0.001
  Camera camera;
  Intrinsics intrinsics = Intrinsics::stated;
  /// Sets the camera where that takes the image, once it is known to be there; false when reported under `place`.
  std::function<bool(const std::string& place, Camera& camera)> find_camera = {};
  Pose world_from_camera;                            ///< OpenCV axes, metres
  std::vector<double> matrix = {};                   ///< 12 or 16 numbers by rows, in the axes of the files: the pose
  std::optional<Split> split = {};                   ///< without one every `test_every`-th photograph is held out
  std::map<std::string, std::string> channels = {};  ///< .npy files of further channels, by name
};

/// What the photographs of a dataset have in common.
struct PhotographRules {
  FrameReadRules read = {
      .depth = DepthGrid::picture};  ///< unknown_labels and the unit of depth are those of parameters and photographs
  bool opengl_files = false;         ///< of SceneInfo; `matrix` is turned
  bool metric = true, tracked = false;  ///< of SceneInfo
  std::string place = {};               ///< of what is wrong with all; "": the root
  std::string poses = {};               ///< the same of their poses, which are from there; "": `place`
  double depth_unit_m = 0;              ///< in place of the photographs'; 0: theirs
  bool with_masks = true;               ///< masks are looked for by the photographs' names
  bool labels_by_name = true;  ///< label images are looked for in `label_dir`; false: the photographs name theirs
  std::vector<std::string> class_folders = {};  ///< in which a class table may lie; none: the root
  std::string class_file = {};                  ///< that the index names
  std::vector<ClassEntry> class_list = {};      ///< that the index holds
  std::optional<ClassTable> classes = {};       ///< that the dataset made itself
};

/// Sets the size of a camera to numbers of a file; false (reported under `place`) unless they are whole numbers of
/// pixels.
bool set_image_size(Camera& camera, double width, double height, const std::string& place, Diagnostics& diagnostics);
/// Sets it to that of the first file of this kind that can be read; the headers of others are checked with their
/// frames.
void set_first_size(Camera& camera, const std::vector<PosedPhotograph>& photographs, std::string FrameFiles::*file);

/// The files of a scene's frames before any is decoded: there or not, of the right size or not.
class FrameFileCheck {
 public:
  explicit FrameFileCheck(MissingFiles missing) : missing_(missing) {}
  /// How many frames will be asked for, for those who show how far it is.
  void expect(std::size_t frames) { frames_ = frames; }

  /// Drops from `files` what is not there. False when the colour image is not: the frame cannot be used. With
  /// MissingFiles::error each is an error under the frame's place.
  bool present(const FrameInfo& frame, FrameFiles& files, Diagnostics& diagnostics);
  /// The same for any file that a frame cannot do without; `what` is as in "pose".
  bool present(const FrameInfo& frame, const char* what, const std::string& path, Diagnostics& diagnostics);
  /// Headers only: sizes as `rules` want them, that of labels and instances that of the picture as it is shown, and
  /// labels of one channel. Each problem goes under the frame's place. Sets FrameInfo::orientation. Returns the size of
  /// the colour image; of one that cannot be read, zeros.
  ImageSize check_headers(FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                          Diagnostics& diagnostics);
  /// After the last frame: says under `source` what was left out and how many images viewers turn by their EXIF
  /// orientation, and refuses a scene of which nothing is left.
  void report(const std::string& source, std::size_t frames_left, Diagnostics& diagnostics) const;

 private:
  MissingFiles missing_;
  std::size_t checked_ = 0, frames_ = 0;
  std::map<std::string, std::vector<std::string>> left_out_;  // what -> names of frames
  std::vector<std::string> turned_;                           // names of frames
};

/// Masks of photographs, found by the photographs' names: files of the folder `folder` under `root`, none where
/// `folder` is empty; and beside each image NAME.jpg the file dynamic_mask_NAME.png, in which everything but black is
/// masked, as instant-ngp has it.
class FrameMasks {
 public:
  FrameMasks(const std::string& root, const std::string& folder);
  /// Sets the masks of `files.color`. That of the folder goes by the image's name with or without its extension, in the
  /// first of folders_like(); a mask that the files name already stays.
  void add_to(FrameFiles& files);
  /// After the last image. A folder without a mask for any is an error, and so is a mask that was found for two
  /// images; one without some is a note; that masks were found beside the images is a note, and so is a folder of masks
  /// that nothing names.
  void report(Diagnostics& diagnostics) const;

 private:
  std::string in_folder(const std::string& image);

  std::string root_, folder_;
  FileNames names_;
  std::size_t images_ = 0, asked_ = 0, found_ = 0, moving_ = 0;
  std::map<std::string, std::vector<std::string>> images_of_;  // by mask
};

/// The frames of a folder. A frame has the size of its photograph.
class PosedPhotographs {
 public:
  PosedPhotographs(const PhotographParams& params, const std::string& config_dir);
  /// Absolute, or from where the program runs.
  const std::string& root() const { return root_; }
  /// The class table that the parameters name; "" = none.
  const std::string& class_file() const { return class_file_; }
  /// The root, or the folder of a root that is a file.
  std::string folder() const;
  /// Throws Error(no_input) unless there are these folders and files in the root; says that `app` writes them.
  void require(std::initializer_list<const char*> parts, const std::string& app) const;
  /// What is looked for before open(), which reports it.
  FrameFileCheck& check() { return check_; }

  /// Checks every N-th of the photographs, in their order, and makes frames of them. What is wrong with one goes into
  /// `diagnostics` under its place.
  SceneInfo open(std::vector<PosedPhotograph> photos, PhotographRules rules, Diagnostics& diagnostics);
  /// Of each frame that open() made, with the files that are there.
  const std::vector<PosedPhotograph>& photographs() const { return photos_; }
  /// As Dataset::read.
  void read(int frame, FrameBuffer& out) const;

 private:
  PhotographParams params_;
  std::string root_, class_file_;
  PhotographRules rules_;
  FrameFileCheck check_;
  SceneInfo info_;
  std::vector<PosedPhotograph> photos_;
};

/// A dataset whose frames are such photographs; `Params` begin with PhotographParams. Its plugin writes
///   SceneInfo find_photographs(const Params& params, PosedPhotographs& files, Diagnostics& diagnostics);
/// which finds the photographs below files.root() and gives them to files.open().
template <class Params>
class PhotographDataset final : public Dataset {
 public:
  PhotographDataset(const Params& params, const DatasetBuild& build)
      : params_(params), config_dir_(build.config_dir), files_(params, config_dir_) {}
  SceneInfo open(Diagnostics& diagnostics) override {
    files_ = PosedPhotographs(params_, config_dir_);
    return find_photographs(params_, files_, diagnostics);
  }
  void read(int frame, FrameBuffer& out) const override { files_.read(frame, out); }

 private:
  Params params_;
  std::string config_dir_;
  PosedPhotographs files_;
};

}  // namespace semfield
