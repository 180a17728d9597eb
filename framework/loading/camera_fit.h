// Whether the camera of a frame is that of its image: the size that it states against the size of the file.
#pragma once

#include <cstddef>
#include <map>
#include <string>
#include <string_view>

#include "formats/image_io.h"
#include "scene/scene.h"

namespace semfield {

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
