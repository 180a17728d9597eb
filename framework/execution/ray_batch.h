// The rays of a training step, what they are compared with, and the losses that come out.
#pragma once

#include "losses/loss_list.h"
#include "losses/semantic_cross_entropy.h"

namespace semfield {

/// A training batch of R rays. Within a tile, rays with a label come first when the source put them there: the head
/// then runs on their samples alone (rays behind the last labelled one of a tile are skipped; their semantic gradient
/// is exactly 0).
struct RayBatch {
  View<const double> origin;     ///< [R, 3]
  View<const double> direction;  ///< [R, 3] unit
  View<const double> near_far;   ///< [R, 2] metres along the ray
  /// Labels are empty when the run has no semantics; a soft label is a row of zeros where the label is kVoid.
  RayTargets targets;
  /// [T, 1], for each tile of tile_rays rays how many of them, the first ones, have no part in the colour loss; empty:
  /// all have.
  View<const std::int64_t> label_only;
  std::int64_t tile_rays = 0;
  std::int64_t skipped = 0;   ///< rays of the first tile that lie before this batch, where it is a part of another
  std::uint32_t terms = ~0U;  ///< bit i: loss i of the list works in this step

  /// Rays [begin, begin + count).
  RayBatch rows(std::int64_t begin, std::int64_t count) const;
  /// The first rays without a part in the colour loss, of a batch that lies in one tile.
  std::int64_t without_color() const;
};

/// Every array of a batch with a row per ray, those with the largest elements first.
template <class Batch, class Visit>
void each_array(Batch& batch, const Visit& visit) {
  visit(batch.origin);
  visit(batch.direction);
  visit(batch.near_far);
  visit(batch.targets.color);
  for (auto& channel : batch.targets.more) visit(channel.view);
  visit(batch.targets.label);
}

/// A batch without its numbers: what another process or a device needs before they come.
struct BatchShape {
  static constexpr std::size_t kNameBytes = 32;
  struct Channel {
    char name[kNameBytes] = {};
    std::int32_t cols = 0;
    bool operator==(const Channel&) const = default;
  };
  std::int64_t rays = 0, tiles = 0, tile_rays = 0;
  std::int32_t channels = 0;
  bool labels = false;
  std::array<Channel, kMostChannels> more{};
  bool operator==(const BatchShape&) const = default;

  /// Views without data and with their rows and columns; those of arrays that are not there have no columns. Names
  /// are borrowed from the shape.
  RayBatch batch() const;
};
BatchShape shape_of(const RayBatch& batch);

/// What the summed squares of a batch's colours are divided by: their number, or 1 without any.
double color_normaliser(const RayBatch& batch);
/// Labels of the first `rays` rays for the cross-entropy.
SemanticTargets semantic_targets(const RayTargets& targets, std::int64_t rays);

struct StepLosses {
  double total = 0;
  double color = 0;           ///< sum over passes of the mean squared error
  double semantic = 0;        ///< sum over passes of the cross-entropy, before lambda
  double mse = 0;             ///< of the last pass
  LossNumbers terms{};        ///< of PipelineOptions::losses: sum over passes, before weight
  std::uint32_t active = 0;   ///< bit i: loss i works in this step
  std::int64_t samples = 0;   ///< of the last pass
  std::int64_t labelled = 0;  ///< rays with a label
  std::int64_t correct = 0;   ///< of them, rays whose largest logit of the last pass is the label
  std::uint32_t dense_passes =
      0;  ///< bit p: pass p met density somewhere. Without it nothing of the pass gets a gradient
};

}  // namespace semfield
