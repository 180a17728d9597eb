// Labels of every s-th pixel of a view, brought to its full size along the edges of the photograph, or to the size
// of its stored image, which training may have made smaller.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "eval/evaluator.h"
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

/// Labels are rendered at every `stride`-th pixel of the stored image, about as many as training saw, and brought to
/// the others along its edges (upsampled).
struct StoredSize {
  Camera camera;            ///< of the stored image
  std::int32_t stride = 1;  ///< FrameOptions::stride
  std::string image;        ///< its file
};

/// None for a frame of that size already, one without an image file, and one whose file has another shape, such as one
/// that is turned by its EXIF data.
std::optional<StoredSize> stored_size_of(const FrameInfo& frame);

/// `rendered`: by `size`'s camera and stride. Labels [height * width] of the stored image; throws as read_rgb.
std::vector<std::int16_t> labels_at(const StoredSize& size, RenderedFrame rendered);

}  // namespace semfield
