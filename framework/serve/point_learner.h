// The semantic part of a pass learned anew from labelled points of the surface, while colour and geometry stand.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "core/small_math.h"
#include "execution/pipeline.h"
#include "surface/surface_graph.h"

namespace semfield {

/// Points with what the network reads of them, [N, dims], row by row.
struct PointRows {
  std::int32_t dims = 0;
  std::vector<float> values;

  std::int64_t count() const { return dims == 0 ? 0 : std::ssize(values) / dims; }
  View<float> view() { return {values.data(), count(), dims}; }
  View<const float> view() const { return {values.data(), count(), dims}; }
};

struct PointLearning {
  std::int64_t steps = 200;
  std::int64_t batch = 512;
  double learning_rate = 5e-3;  ///< falls to a tenth along half a cosine
  double weight_decay = 1e-2;   ///< fraction of a value times the learning rate [Loshchilov19]
  double class_power = 0.75;    ///< a class is drawn as often as the weight of its points to this power says
  std::uint64_t seed = 1;       ///< of the order of points and of dropout
};

/// Works on the semantic tensors of the pipeline's last pass where its executor runs (execution/point_network.h).
/// Nothing else of the pipeline may run meanwhile.
class PointLearner {
 public:
  /// Borrows the pipeline, which must be trainable and have semantics.
  explicit PointLearner(Pipeline<float>& pipeline);

  std::int32_t classes() const { return classes_; }
  /// What the network reads at world positions. Valid while the geometry stays.
  PointRows rows_at(std::span<const Vec3d> positions);

  /// Puts the semantic tensors back to where the run began and learns the points: rows, and a logit each. A
  /// class is drawn by PointLearning::class_power, a point of it by `weight` (empty: all alike). The
  /// moments of the optimiser are zero afterwards. The same bits for any number of threads.
  void learn(const PointRows& rows, std::span<const std::int16_t> logit, std::span<const float> weight,
             const PointLearning& options);

  /// The semantic tensors with their moments, to be put back as they were.
  using Kept = std::vector<std::vector<float>>;
  Kept keep() const;
  void put_back(const Kept& kept);

  /// Class probabilities [N, classes] of points; logits whose entry of `live` is false get none.
  std::vector<float> probabilities(const PointRows& rows, const std::vector<bool>& live);
  /// logits [N, classes].
  std::vector<float> logits(const PointRows& rows);

 private:
  Pipeline<float>& pipeline_;
  std::int32_t classes_ = 0;
  std::vector<Tensor<float>*> tensors_;  // semantic, with gradients
};

/// Probabilities from logits, in place: [N, classes].
void softmax_live(std::span<float> logits, std::int32_t classes, const std::vector<bool>& live);

// The temperature of a labelling session's class probabilities, by clicks that were held back [Guo17, Sec. 4.2].

inline constexpr int kCalibrationFolds = 5;

/// A click that was held back: its class probabilities by what was learned from the other clicks, and how much of the
/// surface it stands for.
struct HeldBack {
  std::vector<float> probability;
  std::size_t truth = 0;
  double counts = 0;
};

/// The fold of each click, by the classes of the clicks: those of a class are dealt out in turn. -1: the class has too
/// few clicks, so that without one it is learned from hardly any, and what is found then says nothing of what is
/// learned from all.
std::vector<int> calibration_folds(std::span<const std::int16_t> classes);

/// The temperature of the largest posterior: the likelihood of the clicks, each counted for its surface and a tenth of
/// them taken for wrong, and a prior around 1. None where they do not settle one: too few of them, or an optimum at a
/// bound.
std::optional<double> fit_temperature(std::span<const HeldBack> held);

// Which click to propose next.

struct Asked {
  std::int32_t point = -1;  ///< of the pool
  double gain = 0;          ///< cells of the surface that it is expected to settle
  std::string_view why;     ///< "unseen" or "uncertain"
};

struct ProposalRules {
  float unseen = 8;            ///< a point this far from every click, or farther, is open
  float reach = 1.5;           ///< a click settles what it spreads to for this
  std::size_t most = 400;      ///< points that one click settles
  double area_power = 0.35;    ///< a region counts by this power of its area: small things have classes too
  double entropy_share = 0.8;  ///< of a point's doubt that the network's entropy shows; the rest is the way to a click
  std::int64_t candidates = 256;
};

/// What a choice knows. `probability` [N, C] of the pool's points; empty while nothing is learned. `passed`: points
/// that somebody did not want to name; `barred`: points that nobody shall name.
struct ProposalInput {
  const SurfacePool* pool = nullptr;
  const SurfaceGraph* graph = nullptr;
  std::span<const float> probability;
  std::int32_t classes = 0;
  std::span<const std::int32_t> passed;
  const std::vector<bool>* barred = nullptr;  ///< [N] points that are never proposed; null or empty: none
  std::uint64_t seed = 1, round = 0;
  ProposalRules rules{};
};

/// The click that would settle most: doubt summed over the surface that it would spread to. None for an empty pool.
std::optional<Asked> choose_click(const ProposalInput& input);

}  // namespace semfield
