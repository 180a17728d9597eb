// Pixels of loaded frames that do not count: masks at another size, and pixels through which a lens has no ray.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "scene/scene.h"

namespace semfield {

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
