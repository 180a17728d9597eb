#include "loading/camera_fit.h"

#include <cmath>
#include <cstdio>

#include "core/error.h"

namespace semfield {

namespace {

std::string factor_number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.4g", value);
  return text;
}

// Of one shape, but for a side that was rounded to whole pixels.
bool is_scaled(const ImageSize& size, const Camera& camera) {
  const double sx = static_cast<double>(size.width_px) / camera.width_px;
  const double sy = static_cast<double>(size.height_px) / camera.height_px;
  return std::abs(sx * camera.height_px - size.height_px) < 1 || std::abs(sy * camera.width_px - size.width_px) < 1;
}

// "2 times as large as": the camera's image against the file.
std::string factor_text(const ImageSize& size, const Camera& camera) {
  const double factor = static_cast<double>(camera.width_px) / size.width_px;
  return factor > 1 ? factor_number(factor) + " times as large" : factor_number(1 / factor) + " times as small";
}

}  // namespace

OtherSize other_size(std::string_view what, const std::string& path, const ImageSize& size, const Camera& camera) {
  OtherSize out{"scene.image.size",
                std::string(what) + " '" + path + "' is " + size_text(size.width_px, size.height_px) +
                    " pixels, the camera " + size_text(camera.width_px, camera.height_px),
                "colour, depth and labels of a frame need the size that its camera states"};
  if (what != kColorImage) return out;
  if (size.width_px != size.height_px && size.width_px == camera.height_px && size.height_px == camera.width_px) {
    out.code = "scene.image.turned";
    if (size.turned_by_exif()) {
      out.message += ", which is that of the picture turned as the file's EXIF orientation says (" +
                     std::to_string(size.orientation) + ")";
      out.remedy = "pixels are read as they are stored: turn them, for example with `mogrify -auto-orient FILES`";
    } else {
      out.message += ": one is turned by a quarter against the other";
      out.remedy = "turn the image files by a quarter, or export the cameras of the images as they are stored";
    }
  } else if (is_scaled(size, camera)) {
    out.code = "scene.camera.size";
    out.message += ": its intrinsics are of images " + factor_text(size, camera);
    out.remedy = "give images of the camera's size, or divide its size, focal lengths and centre by " +
                 factor_number(static_cast<double>(camera.width_px) / size.width_px);
  }
  return out;
}

bool CameraFit::fit(const std::string& image, const std::string& place, Camera& camera, Diagnostics& diagnostics) {
  ImageSize size;
  try {
    size = image_size(image);
  } catch (const Error&) {
    return true;
  }
  if (size.width_px == camera.width_px && size.height_px == camera.height_px) return true;
  if (!is_scaled(size, camera)) {
    OtherSize wrong = other_size(kColorImage, image, size, camera);
    const bool turned = size.width_px == camera.height_px && size.height_px == camera.width_px;
    diagnostics.error(turned ? wrong.code : Code("scene.image.aspect"), place,
                      turned ? wrong.message : wrong.message + ": another aspect ratio",
                      turned ? wrong.remedy : "give the images that the cameras were made from, or scaled copies");
    return false;
  }
  Scaled& one = scaled_[factor_text(size, camera)];
  if (one.frames++ == 0) {
    one.text = size_text(size.width_px, size.height_px) + " pixels, the cameras' " +
               size_text(camera.width_px, camera.height_px) + ", " + factor_text(size, camera);
  }
  camera = camera.resized(size.width_px, size.height_px);
  return true;
}

void CameraFit::report(const std::string& source, Diagnostics& diagnostics) const {
  for (const auto& [factor, one] : scaled_) {
    diagnostics.note(
        "scene.camera.scaled", source,
        "images are " + one.text + ": the intrinsics of " + std::to_string(one.frames) + " frames were scaled");
  }
}

}  // namespace semfield
