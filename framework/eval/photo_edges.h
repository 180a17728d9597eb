// Labels that cling to a photograph: what rays tell of a few pixels spreads over the photograph as far as its edges let
// it.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace semfield {

/// Values that spread over a photograph and stop at its edges: a recursive filter along rows and columns, in turn
/// [Gastal11, Sec. 5]. A way of one pixel is 1 plus the step of colour on it; what is `reach` away still counts
/// 1/e^1.4.
class PhotoEdges {
 public:
  /// `rgb` [height * width * 3]; read here alone.
  PhotoEdges(std::span<const std::uint8_t> rgb, std::int32_t width_px, std::int32_t height_px);

  /// Columns of values that are filtered together.
  static constexpr std::int32_t kColumns = 8;
  /// `values` [height * width * kColumns], in place. The same bits for any number of threads.
  void spread(std::span<float> values) const;

 private:
  std::int32_t width_px_, height_px_;
  // Steps of colour between a pixel and the one left of it, above it: sums over channels of |differences|, in 1/16.
  std::vector<std::uint16_t> from_left_, from_above_;
};

/// What is known of classes at every `stride`-th pixel of a frame (eval/evaluator.h: strided_place).
struct ClassEvidence {
  std::int32_t stride = 1, width_px = 0, height_px = 0;
  std::span<const float> probability;  ///< [height * width * label.size()]; a row of zeros says nothing
  std::vector<std::int16_t> label;     ///< of each column; kVoid: that nothing is there
  std::int32_t frame_width_px = 0, frame_height_px = 0;  ///< 0: the frame has the photograph's size
};

/// Of every pixel of the picture.
struct PhotoLabels {
  std::vector<std::int16_t> label;
  std::vector<float> confidence;  ///< probability of that label
  std::vector<float> entropy;     ///< nats
};

/// `rgb` [height * width * 3]: the photograph, or the rendered colour of a view that has none. A pixel that is sure of
/// its class says more than one that is not. Specks take the class around them: pieces below 1/4096 of the picture,
/// and unsure ones below a hundredth.
PhotoLabels labels_on_photo(const ClassEvidence& evidence, std::span<const std::uint8_t> rgb, std::int32_t width_px,
                            std::int32_t height_px);

struct FrameInfo;
struct RenderedFrame;
/// Of a frame rendered with FrameOptions::probability of so many classes.
PhotoLabels labels_on_photo(const RenderedFrame& frame, int classes, std::span<const std::uint8_t> rgb,
                            std::int32_t width_px, std::int32_t height_px);

/// Labels [height * width] of a rendered frame of the scene: along the edges of its photograph, which is read from the
/// frame's file and brought to that size; of the rendered colour where there is no frame or no file, or one that is
/// smaller or of another shape, such as one that is turned by its EXIF data. Throws as read_rgb.
std::vector<std::int16_t> clinging_labels(const FrameInfo* info, const RenderedFrame& rendered, int classes,
                                          std::int32_t width_px, std::int32_t height_px);

}  // namespace semfield
