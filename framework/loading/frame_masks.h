// Masks of photographs, found by the photographs' names: in a folder, or beside them.
#pragma once

#include <cstddef>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "core/error.h"
#include "loading/file_names.h"
#include "loading/frame_files.h"

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

}  // namespace semfield
