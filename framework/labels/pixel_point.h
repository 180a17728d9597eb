// A place in an image.
#pragma once

namespace semfield {

/// Pixels, continuous: (0, 0) is the upper left corner of the image, the centre of pixel (i, j) is (i + 0.5, j + 0.5).
struct PixelPoint {
  double x = 0, y = 0;
  bool operator==(const PixelPoint&) const = default;
};

}  // namespace semfield
