// Masks of photographs, found by the photographs' names: in a folder, or beside them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "core/error.h"
#include "loading/frame_files.h"
#include "scene/scene.h"

namespace semfield {

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

// Pixels of loaded frames that do not count: masks at another size, and pixels through which a lens has no ray.

struct PixelSize {
  std::int32_t width_px = 0, height_px = 0;
};

/// `used` [from.height * from.width] at a size of at most its own: a pixel is masked where any masked one falls into
/// it, so that none of what is masked shines through. An empty mask stays empty.
std::vector<std::uint8_t> reduced_mask(const std::vector<std::uint8_t>& used, PixelSize from, PixelSize to);

/// Pixels without a ray, of each lens that has any.
class LensMasks {
 public:
  /// Cameras at the loaded size; one without a size is passed over.
  explicit LensMasks(const std::vector<Camera>& cameras);
  /// Masks them in a frame of that camera.
  void add_to(const Camera& camera, FrameBuffer& frame) const;

 private:
  std::vector<std::pair<Camera, std::vector<std::uint8_t>>> masks_;
};

}  // namespace semfield
