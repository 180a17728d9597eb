// One frame kept as image files: checked by their headers, read into house units. Datasets made of image files share
// it.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <map>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "scene/camera.h"
#include "scene/scene.h"

namespace semfield {

// Depth kept as an image or as a NumPy array.

/// Whether values are taken as they are: files of real numbers (.exr, .pfm, .npy, .tif) are in the unit of the poses.
bool has_real_depth(const std::string& path);

/// The size of an image, or of the array of a .npy file, [height, width] with axes of length 1 besides. Throws as
/// image_size and npy_shape do.
ImageSize depth_size(const std::string& path);

/// z-depth in metres at the file's own size; 0 where it is not finite, negative, or at the 16-bit ceiling 65535.
/// `unit_m` are the metres of one step where the values are integers. Throws as the readers of images and arrays do.
Image<float> read_depth(const std::string& path, double unit_m = 0.001);

// Depth that another camera than the one of the colours took, drawn into the colour image.

struct DepthCamera {
  Camera camera;          ///< at the size of the depth images
  Pose depth_from_color;  ///< OpenCV axes of both, unit of the poses
};

/// [H * W] depth (Camera::depth_of) of the colour camera; 0 where none is seen. The surface between neighbouring depth
/// pixels is drawn, the nearest of several; across an edge, where depth jumps by over 4 %, there is none.
std::vector<float> drawn_depth(const Image<float>& depth, const DepthCamera& from, const Camera& color);

/// Paths; "" where the frame has no such channel.
struct FrameFiles {
  std::string color, depth, label, instance;
  std::string mask = {};    ///< black is masked
  std::string moving = {};  ///< a mask of moving things, as instant-ngp has it: what is not black is masked

  /// Sets has_depth, has_labels and has_instances.
  void tell_channels(FrameInfo& frame) const {
    frame.has_depth = !depth.empty();
    frame.has_labels = !label.empty();
    frame.has_instances = !instance.empty();
  }
};

/// Throws Error(no_input) for a folder that is not there.
void require_folder(const std::filesystem::path& folder, const std::string& remedy);
/// The extension in small letters: ".jpg".
std::string ending_of(const std::string& path);
/// Of photographs, as `files_with` takes them.
inline constexpr std::array<std::string_view, 5> kPhotographs{".jpg", ".jpeg", ".png", ".tif", ".tiff"};
/// Paths of the files of a folder whose extension, in small letters, is one of these; in the order of their names,
/// without masks of moving things. None for a folder that is not there.
std::vector<std::string> files_with(const std::string& folder, std::span<const std::string_view> extensions);

/// The photographs of a folder by the number that is their name: 12 for "12.jpg" or "0012.png". Names that are none and
/// numbers that occur twice are reported.
std::map<std::int64_t, std::string> numbered_photographs(const std::string& folder, Diagnostics& diagnostics);

/// What a label id outside the class table is; the parameter `unknown_labels` of datasets made of image files.
enum class UnknownLabels { error, as_void };
SEMFIELD_CHOICES(UnknownLabels, "error", "void");

/// What every dataset with that parameter says to ids outside the table.
inline constexpr const char* kUnknownLabelRemedy =
    "add what is missing to the class table, or read it as void with --set scene.unknown_labels=void";

/// What to do about labels whose size is that of the stored pixels of an image that viewers turn by a quarter.
inline constexpr const char* kShownRemedy =
    "draw labels over the image as viewers show it; or take the orientation out of the image files, for example with "
    "`exiftool -Orientation= FILES`, and labels count by the pixels as stored";

struct FrameReadRules {
  double depth_unit_m = 0.001;  ///< metres of one step of an integer depth image; real numbers are metres
  int alpha_background = -1;    ///< see read_rgb
  bool alpha = false;           ///< as a further channel
  UnknownLabels unknown_labels = UnknownLabels::error;  ///< what an id outside the class table is
  const DepthCamera* depth_camera = nullptr;            ///< that took the depth, where it is another
  bool alpha_masks = false;                             ///< pixels of the colour image that are not opaque are masked
};

/// What becomes of a frame whose index names files that are not there; the parameter `missing` of datasets made of
/// image files.
enum class MissingFiles { error, skip };
SEMFIELD_CHOICES(MissingFiles, "error", "skip");
/// What those datasets say of the parameter.
inline constexpr const char* kMissingSentence =
    "what happens when files are missing: error, or skip: a frame without image or pose is left out, and other "
    "frames go without the channel";

/// The files of a scene's frames before any is decoded: there or not, of the right size or not.
class FrameFileCheck {
 public:
  /// `labels_key` is the parameter that, left empty, turns the scene's own labels off; "" where there is none.
  FrameFileCheck(MissingFiles missing, std::string labels_key)
      : missing_(missing), labels_key_(std::move(labels_key)) {}
  /// How many frames will be asked for, for those who show how far it is.
  void expect(std::size_t frames) { frames_ = frames; }

  /// Drops from `files` what is not there. False when the colour image is not: the frame cannot be used. With
  /// MissingFiles::error each is an error under the frame's place.
  bool present(const FrameInfo& frame, FrameFiles& files, Diagnostics& diagnostics);
  /// The same for any file that a frame cannot do without; `what` is as in "pose".
  bool present(const FrameInfo& frame, const char* what, const std::string& path, Diagnostics& diagnostics);
  /// Headers only: every size equal to the camera's, that of labels and instances to the picture's as it is shown, and
  /// labels of one channel. Each problem goes under the frame's place. Sets FrameInfo::orientation. Returns the size of
  /// the colour image; of one that cannot be read, zeros.
  /// Depth has the size of `depth_camera` where one is given.
  ImageSize check_headers(FrameInfo& frame, const FrameFiles& files, Diagnostics& diagnostics,
                          const DepthCamera* depth_camera = nullptr);
  /// After the last frame: says under `source` what was left out and how many images viewers turn by their EXIF
  /// orientation, and refuses a scene of which nothing is left.
  void report(const std::string& source, std::size_t frames_left, Diagnostics& diagnostics) const;

 private:
  MissingFiles missing_;
  std::string labels_key_;
  std::size_t checked_ = 0, frames_ = 0;
  std::map<std::string, std::vector<std::string>> left_out_;  // what -> names of frames
  std::vector<std::string> turned_;                           // names of frames
};

/// Of a picture of what the colour camera sees, at any size: reports one of another aspect ratio by over 2 %, and one
/// that cannot be read. `labels_key` as in FrameFileCheck where it is a label image, which then has one channel; else
/// "". An empty path is passed over.
void check_shape(const std::string& path, const FrameInfo& frame, const std::string& labels_key,
                 Diagnostics& diagnostics);
/// Reports a folder of label images without any for the scene's frames; notes that some have none.
void report_unlabelled(const std::string& folder, std::size_t labelled, std::size_t frames, Diagnostics& diagnostics);

/// Pixels; labels and instances are files of the picture as it is shown. Depth 0, not finite, negative, or at the
/// 16-bit ceiling 65535 reads as 0 (invalid). Throws Error naming frame and file; UnknownLabelError for ids outside
/// `classes`.
void read_frame_files(const FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                      const ClassTable& classes, FrameBuffer& out);

/// The class table nearest to a scene: classes.yaml, classes.yml, classes.csv, info_semantic.json in each folder in
/// turn; "" when none.
std::string find_class_file(const std::vector<std::string>& folders);

/// The class table `path`, or where that is empty the one that find_class_file finds. With labels but without a table,
/// and for a table that cannot be read, an error goes into `diagnostics` and the table is empty.
ClassTable load_class_file(const std::string& path, const std::vector<std::string>& folders, bool has_labels,
                           Diagnostics& diagnostics);

/// Names for frames, each given once.
class FrameNames {
 public:
  /// The stem of the image's path, whose separators may be Windows'; where another frame took it, its folder is added,
  /// then a number.
  std::string of(const std::string& image_path);

 private:
  std::map<std::string, int> next_;  // given names -> the number that the next of that name gets
};

// Files by the names that an index gives them: one that another system wrote may spell a path in another way.

/// Finds files under names of another system; each folder is listed once. For one thread.
class FileNames {
 public:
  /// The path of the file that `path` means: as it stands where that is there; else with slashes for Windows'
  /// backslashes; else with those parts that differ from the only name in their folder that looks the same by nothing
  /// but the form of its letters (core/text.h). Where nothing is there: `path` with slashes.
  std::string of(const std::string& path);

 private:
  const std::string* looks_like(const std::string& folder, const std::string& name);

  std::map<std::string, std::map<std::string, std::string>> folders_;  // -> by decomposed name; "" for one of several
};

/// With slashes for backslashes.
std::string with_slashes(std::string path);

// JSON files of poses and cameras.

/// The whole file. Throws as read_pose_file, and Error(data) for what is no JSON and for a map that has one key twice,
/// of which a parser would keep the last without a word. `Json` is a type of nlohmann-json, which no header names.
template <class Json>
Json read_pose_json(const std::string& path, const char* remedy) {
  std::string twice;
  Json root;
  try {
    root = parse_json<Json>(read_pose_file(path), twice, [](int) {});
  } catch (const typename Json::exception& e) {
    throw Error(ErrorKind::data, "scene.index.format", "'" + path + "' is not valid JSON: " + json_cause(e.what()),
                remedy);
  }
  if (!twice.empty())
    throw Error(ErrorKind::data, "scene.index.twice", "'" + path + "' has the key '" + twice + "' twice in one map",
                "keep one of the two");
  return root;
}

// Masks of photographs, found by the photographs' names: in a folder, or beside them.

/// What datasets say of their parameter `masks`.
inline constexpr const char* kMasksSentence =
    "folder of masks, from root: NAME.png or NAME.jpg.png for the image NAME.jpg, black (0) where a pixel is masked; "
    "masked pixels draw no rays and are in no score; empty = none";

/// Where under `folder` a file that belongs to `image` may lie, the likeliest first: in folders called as the last
/// three, two and one of the image's own, then in `folder` itself.
std::vector<std::filesystem::path> folders_like(const std::filesystem::path& folder,
                                                const std::filesystem::path& image);

/// Files of the folder `folder` under `root`, none where `folder` is empty; and beside each image NAME.jpg the file
/// dynamic_mask_NAME.png, in which everything but black is masked, as instant-ngp has it.
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

}  // namespace semfield
