#include "loading/frame_masks.h"

#include <algorithm>
#include <filesystem>

#include "compute/parallel.h"

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

// A lens whose border pixels all have rays has one for every pixel: what it bends lies between the axis and the border.

namespace {

bool has_ray(const Camera& camera, std::int64_t x, std::int64_t y) {
  return !(camera.direction(static_cast<double>(x) + 0.5, static_cast<double>(y) + 0.5) == Vec3d{0, 0, 0});
}

bool has_rays_along_border(const Camera& camera) {
  const std::int64_t right = camera.width_px - 1, bottom = camera.height_px - 1;
  for (std::int64_t x = 0; x <= right; ++x)
    if (!has_ray(camera, x, 0) || !has_ray(camera, x, bottom)) return false;
  for (std::int64_t y = 0; y <= bottom; ++y)
    if (!has_ray(camera, 0, y) || !has_ray(camera, right, y)) return false;
  return true;
}

}  // namespace

std::vector<std::uint8_t> reduced_mask(const std::vector<std::uint8_t>& used, PixelSize from, PixelSize to) {
  if (used.empty()) return {};
  std::vector<std::uint8_t> out(static_cast<std::size_t>(std::int64_t{to.width_px} * to.height_px), 1);
  // Of the pixels `from`, those that pixel `at` of `to` covers a part of.
  const auto covered = [](std::int64_t at, std::int64_t size, std::int64_t many) {
    return std::pair{at * many / size, ((at + 1) * many + size - 1) / size};
  };
  parallel_for(to.height_px, [&](std::int64_t y) {
    const auto [top, bottom] = covered(y, to.height_px, from.height_px);
    for (std::int64_t x = 0; x < to.width_px; ++x) {
      const auto [left, right] = covered(x, to.width_px, from.width_px);
      for (std::int64_t row = top; row < bottom; ++row) {
        const auto begin = used.begin() + row * from.width_px;
        if (std::find(begin + left, begin + right, std::uint8_t{0}) != begin + right)
          out[static_cast<std::size_t>(y * to.width_px + x)] = 0;
      }
    }
  });
  return out;
}

LensMasks::LensMasks(const std::vector<Camera>& cameras) {
  std::vector<Camera> known;
  for (const Camera& camera : cameras) {
    if (camera.width_px == 0 || !camera.has_distortion() ||
        std::find(known.begin(), known.end(), camera) != known.end())
      continue;
    known.push_back(camera);
    if (has_rays_along_border(camera)) continue;
    std::vector<std::uint8_t> used(static_cast<std::size_t>(std::int64_t{camera.width_px} * camera.height_px));
    parallel_for(camera.height_px, [&](std::int64_t y) {
      for (std::int64_t x = 0; x < camera.width_px; ++x)
        used[static_cast<std::size_t>(y * camera.width_px + x)] = has_ray(camera, x, y) ? 1 : 0;
    });
    masks_.emplace_back(camera, std::move(used));
  }
}

void LensMasks::add_to(const Camera& camera, FrameBuffer& frame) const {
  const auto own = std::find_if(masks_.begin(), masks_.end(), [&](const auto& mask) { return mask.first == camera; });
  if (own == masks_.end()) return;
  if (frame.used.empty()) frame.used.assign(own->second.size(), 1);
  for (std::size_t i = 0; i < frame.used.size(); ++i) frame.used[i] = frame.used[i] & own->second[i];
}

}  // namespace semfield
