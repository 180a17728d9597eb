// The field at points of space, apart from rays: what it returns there, and the semantic part learned from points.
#pragma once

#include <span>

#include "execution/executor.h"
#include "execution/pipeline.h"
#include "execution/thread_arenas.h"

namespace semfield {

/// Points and where results go, host memory; N rows each, empty = not wanted.
template <class Real>
struct PointQuery {
  View<const double> position;   ///< [N, 3] world
  View<const double> direction;  ///< [N, 3] unit vectors that points are seen along; for `color` alone
  View<Real> sigma;              ///< [N, 1] density after activation, 1/m
  View<Real> color;              ///< [N, 3] in (0, 1)
  View<Real> logits;             ///< [N, K] of a sample of weight 1; only where the pipeline has semantics
};

/// Answers of the last pass, computed by the CPU from the pipeline's store, whatever its steps run on: where that
/// is a device, bring the store up to date first (Executor::download). The same bits for any grouping of points into
/// calls and any number of threads. Not beside another call.
template <class Real>
void query_points(Pipeline<Real>& pipeline, const PointQuery<Real>& query);

/// Steps of learning from points: which points each of them takes, and its update. Host memory.
template <class Real>
struct PointLessons {
  View<const Real> rows;                 ///< [N, dims] of PointNetwork::rows
  std::span<const std::int16_t> logit;   ///< [N]
  std::span<const std::int32_t> choice;  ///< [steps, batch] numbers of points
  std::int64_t batch = 0;
  std::span<const AdamStep> updates;  ///< [steps]
  double weight_decay = 0;            ///< of weights, not biases: fraction of a value times the learning rate
};

/// The semantic part of the last pass at points of space, where the executor's steps run. Semantic tensors are those of
/// its branch, if it has one, and of its head. Views are host memory. Only for pipelines with semantics, and not beside
/// another call of the executor.
template <class Real>
class PointNetwork {
 public:
  virtual ~PointNetwork() = default;
  /// What the network reads at world positions [N, 3] (Pass::point_rows); valid while the geometry stays.
  virtual void rows(View<const double> positions, View<Real> rows) = 0;
  /// logits [N, C] of points with these rows.
  virtual void logits(View<const Real> rows, View<Real> logits) = 0;
  /// Trains the semantic tensors, which begin as they lie in the store. Store and executor have them afterwards, with
  /// moments of zero. The pipeline must be trainable.
  virtual void learn(const PointLessons<Real>& lessons) = 0;
  /// Brings the semantic tensors of the store up to date, or takes them over from it, with their moments.
  virtual void read() = 0;
  virtual void write() = 0;
};

/// On the CPU, from the pipeline's store. The same bits for any number of threads.
template <class Real>
class LanePoints final : public PointNetwork<Real> {
 public:
  /// Borrows the pipeline.
  explicit LanePoints(Pipeline<Real>& pipeline) : pipeline_(pipeline) {}
  void rows(View<const double> positions, View<Real> rows) override;
  void logits(View<const Real> rows, View<Real> logits) override;
  void learn(const PointLessons<Real>& lessons) override;
  void read() override {}
  void write() override;

 private:
  void gradients(std::int64_t step, View<const Real> input, View<const std::int16_t> logit,
                 const std::vector<Tensor<Real>*>& tensors);
  StepContext context(std::int64_t step, bool training, Workspace& arena) const;
  const Pass<Real>& pass() const { return pipeline_.passes().back(); }

  Pipeline<Real>& pipeline_;
  ThreadArenas arenas_;
};

/// Those of the store that labels shape.
template <class Real>
std::vector<Tensor<Real>*> semantic_tensors(ParamStore<Real>& store);

}  // namespace semfield
