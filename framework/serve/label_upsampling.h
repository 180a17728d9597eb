// Labels of a view's every so manieth pixel, brought to its full size along the edges of the photograph.
#pragma once

#include <cstdint>
#include <vector>

#include "scene/stored_frame.h"

namespace semfield {

struct ViewLabels;

/// Maps [height * width] of every `stride`-th pixel (eval/pixel_stride.h).
struct CoarseLabels {
  std::int32_t stride = 1, width_px = 0, height_px = 0;
  std::vector<std::int16_t> label;
  std::vector<std::uint8_t> entropy;
};

/// A pixel takes the label with the most weight among its four neighbours in the coarse map, weighted bilinearly and by
/// how near their colours are to its own [Kopf07]; its entropy is their weighted mean.
ViewLabels upsampled(const CoarseLabels& coarse, const StoredFrame& photo);

}  // namespace semfield
