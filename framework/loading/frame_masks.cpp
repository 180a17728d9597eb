#include "loading/frame_masks.h"

#include <filesystem>

namespace semfield {

namespace fs = std::filesystem;

std::vector<fs::path> folders_like(const fs::path& folder, const fs::path& image) {
  std::vector<fs::path> tails, singles;
  fs::path tail;
  for (fs::path at = image.parent_path(); tails.size() < 3 && at.has_filename(); at = at.parent_path()) {
    tail = tail.empty() ? at.filename() : at.filename() / tail;
    if (!tails.empty()) singles.push_back(folder / at.filename());
    tails.insert(tails.begin(), folder / tail);
  }
  tails.insert(tails.end(), singles.begin(), singles.end());
  tails.push_back(folder);
  return tails;
}

FrameMasks::FrameMasks(const std::string& root, const std::string& folder)
    : root_(root), folder_(folder.empty() ? "" : (fs::path(root) / folder).string()) {}

void FrameMasks::add_to(FrameFiles& files) {
  ++images_;
  if (files.mask.empty() && !folder_.empty()) files.mask = in_folder(files.color);
  const fs::path image(files.color);
  const std::string beside = names_.of((image.parent_path() / (kMovingMask + image.stem().string() + ".png")).string());
  std::error_code unknown;
  if (!fs::is_regular_file(beside, unknown)) return;
  files.moving = beside;
  ++moving_;
}

std::string FrameMasks::in_folder(const std::string& image) {
  ++asked_;
  const fs::path path(image);
  for (const fs::path& where : folders_like(folder_, path)) {
    for (const std::string& name : {path.stem().string(), path.filename().string()}) {
      for (const char* extension : {".png", ".jpg", ".jpeg"}) {
        const std::string file = names_.of((where / (name + extension)).string());
        std::error_code unknown;
        if (!fs::is_regular_file(file, unknown) || fs::equivalent(file, path, unknown)) continue;
        ++found_;
        images_of_[file].push_back(image);
        return file;
      }
    }
  }
  return "";
}

void FrameMasks::report(Diagnostics& diagnostics) const {
  std::error_code unknown;
  if (moving_ > 0)
    diagnostics.note("scene.mask.moving", root_,
                     std::to_string(moving_) + " of " + std::to_string(images_) + " images have a " + kMovingMask +
                         "NAME.png next to them: what is not black in it is masked");
  if (folder_.empty()) {
    if (fs::is_directory(fs::path(root_) / "masks", unknown))
      diagnostics.note(
          "scene.mask.unread", root_,
          "there is a folder 'masks', which is not read; scene.masks: masks leaves out what is black in it");
    return;
  }
  for (const auto& [file, images] : images_of_) {
    if (images.size() < 2) continue;
    diagnostics.error("scene.mask.ambiguous", "'" + file + "'",
                      "is the mask of '" + images[0] + "' and of '" + images[1] + "' by its name",
                      "put masks into folders called as those of the images");
    break;
  }
  if (found_ == 0) {
    diagnostics.error("scene.mask.missing", folder_,
                      fs::is_directory(folder_, unknown) ? "no mask for any image" : "the folder of masks is missing",
                      "name the masks as the images, with .png, or correct scene.masks");
  } else if (found_ < asked_) {
    diagnostics.note("scene.mask.missing", folder_,
                     std::to_string(asked_ - found_) + " of " + std::to_string(asked_) +
                         " images have no mask: all of their pixels count");
  }
}

}  // namespace semfield
