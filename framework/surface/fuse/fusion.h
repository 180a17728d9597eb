// Labels of posed views fused in each view's pixels: what the views that see a pixel's surface point predict there.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "labels/training_labels.h"
#include "surface/fuse/class_votes.h"
#include "surface/fuse/correspondence.h"

namespace semfield {

/// A view and its prediction; borrowed.
struct FusionView {
  PosedDepth seen;
  const TrainingLabels::Frame* prediction = nullptr;
};

/// Pixels of one or several fused frames.
struct FusionCounts {
  std::int64_t pixels = 0;
  std::int64_t without_depth = 0;  ///< keep their own prediction
  std::int64_t unlabelled = 0;     ///< no prediction of their own, void
  std::int64_t filled = 0;         ///< of those, labelled by other views
  std::int64_t votes = 0;          ///< predictions of all pixels with depth, the own one included

  void merge(const FusionCounts& other);
  /// Predictions per pixel with depth; 0 without such pixels.
  double views_mean() const;
  bool operator==(const FusionCounts&) const = default;
};

struct FusedFrame {
  /// By FusionMethod: [H * W] class index, kVoid = void.
  std::array<std::vector<std::int16_t>, 3> label;
  FusionCounts counts;
};

/// For each pixel of a view: its surface point by depth, every chosen view that sees the point (seen_at), their
/// predictions there and the pixel's own, multiplied (`bayesian`) or averaged (`average`) [Zhi21, section 4.4]. A pixel
/// without depth keeps its own prediction. Where classes are equally probable the pixel's own label wins.
class LabelFusion {
 public:
  /// Views stay the caller's. Throws Error(config) for a hard_confidence that says nothing among `classes`,
  /// Error(internal) for maps of another size than their camera, Error(data) for a label outside the classes.
  LabelFusion(std::span<const FusionView> views, int classes, const FusionParams& params);

  /// Rows in parallel; the bits do not depend on threads.
  FusedFrame fuse(int target) const;

 private:
  struct Scratch;
  void fuse_pixel(int target, std::span<const int> others, std::int32_t column, std::int32_t row, Scratch& scratch,
                  FusedFrame& out) const;
  void add_prediction(const FusionView& view, const PixelHit& hit, Scratch& scratch) const;
  bool prediction_at(const FusionView& view, std::size_t pixel, Scratch& scratch) const;

  std::span<const FusionView> views_;
  int classes_;
  FusionParams params_;
  HardLikelihood hard_;
  std::vector<PosedDepth> seen_;
};

}  // namespace semfield
