// The semantic part of a pass learned anew from labelled points of the surface, while colour and geometry stand.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/small_math.h"
#include "execution/pipeline.h"

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

}  // namespace semfield
