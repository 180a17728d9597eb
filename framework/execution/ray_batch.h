// The rays of a training step, what they are compared with, and the losses that come out.
#pragma once

#include "losses/loss_list.h"

namespace semfield {

/// A training batch of R rays. Within a tile, rays with a label come first when the source put them there: the head
/// then runs on their samples alone (rays behind the last labelled one of a tile are skipped; their semantic gradient
/// is exactly 0).
struct RayBatch {
  View<const double> origin;       ///< [R, 3]
  View<const double> direction;    ///< [R, 3] unit
  View<const double> near_far;     ///< [R, 2] metres along the ray
  View<const float> target;        ///< [R, 3] colour in [0, 1]
  View<const std::int16_t> label;  ///< [R, 1] class or kVoid; empty when the run has no semantics
  View<const float> soft;   ///< [R, C] probabilities, a row of zeros where label is kVoid; empty: labels are hard
  View<const float> depth;  ///< [R, 1] metres along the ray, 0: unknown; empty: no term asks for it
  /// Share of the rays, the first ones of every tile, that have no part in the colour loss.
  double label_only_share = 0;
  std::uint32_t terms = ~0U;  ///< bit i: term i of the list of losses works in this step
};

/// How many of the rays [begin, end) of a batch, a tile, are among those: every ray whose running share crosses an
/// integer, so that the count of a batch does not depend on its tiles.
std::int64_t label_only_rays(double share, std::int64_t begin, std::int64_t end);
/// What terms of the loss compare a batch with.
RayTargets targets_of(const RayBatch& batch);
/// What the summed squares of a batch's colours are divided by: their number, or 1 without any.
double color_normaliser(const RayBatch& batch);

struct StepLosses {
  double total = 0;
  double color = 0;           ///< sum over passes of the mean squared error
  double semantic = 0;        ///< sum over passes of the cross-entropy, before lambda
  double mse = 0;             ///< of the last pass
  LossNumbers terms{};        ///< of PipelineOptions::losses: sum over passes, before weight
  std::uint32_t active = 0;   ///< bit i: term i works in this step
  std::int64_t samples = 0;   ///< of the last pass
  std::int64_t labelled = 0;  ///< rays with a label
  std::int64_t correct = 0;   ///< of them, rays whose largest logit of the last pass is the label
  std::uint32_t dense_passes =
      0;  ///< bit p: pass p met density somewhere. Without it nothing of the pass gets a gradient
};

}  // namespace semfield
