// Losses on the device, twins of losses/: gradients per ray, and sums of a step in a fixed order.
#pragma once

#include <cstdint>

#include "core/view.h"
#include "core/workspace.h"
#include "cuda/launch.h"
#include "losses/loss_list.h"
#include "losses/semantic_cross_entropy.h"
#include "model/stages.h"

namespace semfield::cuda {

/// Sums of one pass over a batch.
struct LossSums {
  double squares = 0;                 ///< sum of squared colour errors over rays and channels
  double semantic = 0;                ///< weighted cross-entropy in nats, before division
  double terms[kMostLossTerms] = {};  ///< of the list `losses`
  std::int64_t labelled = 0;
  std::int64_t correct = 0;
  std::int64_t samples = 0;  ///< in use
  std::int32_t dense = 0;    ///< 1: some sample has density
};

/// d_color = 2 (color - target) / normaliser [R, 3], and sums->squares in a fixed order (sums: device memory). Sums of
/// blocks go through `arena`.
void photometric_loss(Workspace& arena, View<const float> color, View<const float> target, double normaliser,
                      View<float> d_color, LossSums* sums);

/// As semfield::semantic_cross_entropy with the normaliser read from launch().cell: d_logits [N, C], sums->semantic,
/// labelled and correct. hard [N, 1] or soft [N, C] (device); class_weight [1, C] (device) or empty. A logit of a
/// labelled ray that is not finite is a fault of Stage::logits, a label outside -1..C-1 or a soft value that is no
/// probability one of Stage::label; such a ray counts as unlabelled.
void semantic_cross_entropy(Workspace& arena, View<const float> logits, const SemanticTargets& targets,
                            View<const float> class_weight, double scale, View<float> d_logits, LossSums* sums);

/// *total = the sum of `count` numbers, all device memory, in an order that depends on `count` alone.
void sum_in_order(const double* numbers, std::int64_t count, double* total);

/// sums->samples = first[R], sums->dense = any sigma > 0.
void count_samples(View<const std::int32_t> first, View<const float> sigma, LossSums* sums);

/// As Stages::class_results.
void class_results(View<float> logits, const ClassResults<float>& results);

// The largest size of a number in a matrix, from which sums in fixed point take their unit.

/// *largest = the larger of itself and the bits of the largest |value| of the rows in use (launch().live_rows); those
/// of a NaN are larger than any number's. Device memory; the order does not matter, so matrices may be looked at beside
/// each other.
void find_largest(View<const float> values, std::uint32_t* largest);

}  // namespace semfield::cuda
