// Masks of photographs: a folder of them, found by the photographs' names.
#pragma once

#include <cstddef>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "core/error.h"

namespace semfield {

/// What datasets say of their parameter `masks`.
inline constexpr const char* kMasksSentence =
    "folder of masks, from root: NAME.png or NAME.jpg.png for the image NAME.jpg, black (0) where a pixel is masked; "
    "masked pixels draw no rays and are in no score; empty = none";

/// Where under `folder` a file that belongs to `image` may lie, the likeliest first: in folders called as the last
/// three, two and one of the image's own, then in `folder` itself.
std::vector<std::filesystem::path> folders_like(const std::filesystem::path& folder,
                                                const std::filesystem::path& image);

/// Files of the folder `folder` under `root`; none where `folder` is empty.
class FrameMasks {
 public:
  FrameMasks(const std::string& root, const std::string& folder);
  /// The mask of an image, by its name with or without its extension, in the first of folders_like(); "" for an image
  /// without one.
  std::string of(const std::string& image);
  /// After the last image. A folder without a mask for any is an error, and so is a mask that was found for two images;
  /// one without some is a note; masks that lie beside the images and that nothing names are told in a note.
  void report(Diagnostics& diagnostics) const;

 private:
  std::string root_, folder_;
  std::size_t asked_ = 0, found_ = 0;
  std::map<std::string, std::vector<std::string>> images_of_;  // by mask
};

}  // namespace semfield
