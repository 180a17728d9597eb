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
/// The path of a file in a folder; "" where there is no such folder.
std::string in_folder(const std::filesystem::path& folder, const std::string& name);
/// The extension in small letters: ".jpg".
std::string ending_of(const std::string& path);
/// Of photographs, as `files_with` takes them.
inline constexpr std::array<std::string_view, 5> kPhotographs{".jpg", ".jpeg", ".png", ".tif", ".tiff"};
/// What the name of a mask of moving things begins with, beside its image [instant-ngp].
inline constexpr const char* kMovingMask = "dynamic_mask_";
/// Paths of the files of a folder whose extension, in small letters, is one of these; in the order of their names,
/// without masks of moving things. None for a folder that is not there.
std::vector<std::string> files_with(const std::string& folder, std::span<const std::string_view> extensions);

/// The photographs of a folder by the number that is their name: 12 for "12.jpg" or "0012.png". Names that are none and
/// numbers that occur twice are reported.
std::map<std::int64_t, std::string> numbered_photographs(const std::string& folder, Diagnostics& diagnostics);

/// What a label id outside the class table is; the parameter `unknown_labels` of datasets made of image files.
enum class UnknownLabels { error, as_void };
SEMFIELD_CHOICES(UnknownLabels, "error", "void");

/// What to do about labels whose size is that of the stored pixels of an image that viewers turn by a quarter.
inline constexpr const char* kShownRemedy =
    "draw labels over the image as viewers show it; or take the orientation out of the image files, for example with "
    "`exiftool -Orientation= FILES`, and labels count by the pixels as stored";

/// The camera of a label or instance image, which is drawn over the picture as viewers show it.
Camera shown_camera(const FrameInfo& frame);

/// What a depth image shows.
enum class DepthGrid : std::uint8_t {
  image,      ///< the pixels of the colour image
  picture,    ///< the same picture at any size, read at the nearest pixel: an average across an edge would be a surface
              ///< that is not there
  apart,      ///< what another camera sees, whose points are drawn
  same_place  ///< what another lens sees from the same place: the pixel that a ray falls into
};

/// How the pixels of a frame are read from its files.
struct FrameReadRules {
  /// The parameter that, left empty, turns the scene's own labels off; "" where there is none.
  std::string labels_key = {};
  double depth_unit_m = 0.001;  ///< metres of one step of an integer depth image; real numbers are metres
  DepthGrid depth = DepthGrid::image;
  DepthCamera depth_camera = {};  ///< that took the depth, where it is another
  std::string confidence = {};    ///< file, as large as the depth, below whose value `least` depth counts as none
  int least = 0;
  int alpha_background = -1;                            ///< see read_rgb
  bool alpha = false;                                   ///< as a further channel
  bool alpha_masks = false;                             ///< pixels of the colour image that are not opaque are masked
  UnknownLabels unknown_labels = UnknownLabels::error;  ///< what an id outside the class table is
  /// Labels and instances show the picture as stored at any size, and are read at the nearest pixel.
  bool labels_of_any_size = false;
  /// Class index of each raw id that label images hold, as ClassTable::index_of; empty: they hold ids of the table.
  std::vector<std::int16_t> class_of_raw = {};
};

/// Pixels; labels and instances are files of the picture as it is shown. Depth 0, not finite, negative, or at the
/// 16-bit ceiling 65535 reads as 0 (invalid). Throws Error naming frame and file; UnknownLabelError for ids outside
/// `classes`.
void read_frame_files(const FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                      const ClassTable& classes, FrameBuffer& out);

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

/// Where under `folder` a file that belongs to `image` may lie, the likeliest first: in folders called as the last
/// three, two and one of the image's own, then in `folder` itself.
std::vector<std::filesystem::path> folders_like(const std::filesystem::path& folder,
                                                const std::filesystem::path& image);

}  // namespace semfield
