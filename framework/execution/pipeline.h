// The whole differentiable renderer: passes over rays, losses, and gradients that do not depend on threads.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/workspace.h"
#include "execution/executor.h"
#include "execution/train_rays.h"
#include "model/camera_corrections.h"
#include "model/losses/semantic_cross_entropy.h"
#include "model/param_store.h"
#include "model/pass.h"
#include "model/stages.h"

namespace semfield {

struct PipelineOptions {
  RenderRules rules;
  std::uint64_t seed = 1;
  std::int64_t rays = 0;  ///< of a step
  /// Gradient slots; the sum's order, so part of a run's identity. 0: what steps of so many rays have work for, never
  /// from the thread count.
  int lanes = 8;
  std::int64_t tile_rays = 0;       ///< 0: from the samplers' capacities, never from the thread count
  std::vector<float> class_weight;  ///< [C] or empty
  LossList losses;                  ///< terms beside colour and semantics
  CameraRules cameras;              ///< what training corrects of its cameras
  WorkSettings work;                ///< threads and matrix products of every call
  bool head_on_all_rays =
      false;  ///< run the head on unlabelled rays too (their gradient is exactly 0): the leave-out's pair
};

/// What the sums of a batch are divided by.
struct BatchScales {
  double color = 1;     ///< squared differences of its colours
  double semantic = 0;  ///< cross-entropies; 0: the batch has no label
  LossScales terms;
};

template <class Real>
class LaneExecutor;

/// Passes and their tensors, and the executor that steps and rendering run on: the CPU's lanes at first. The
/// lanes stay, because they name the ray and tensor behind a fault that a device met.
template <class Real>
class Pipeline {
 public:
  Pipeline(std::vector<PassParts<Real>> passes, PipelineOptions options, bool trainable);
  ~Pipeline();

  ParamStore<Real>& store() { return store_; }
  const ParamStore<Real>& store() const { return store_; }
  const std::vector<Pass<Real>>& passes() const { return passes_; }
  /// With the numbers of lanes and of a tile's rays.
  const PipelineOptions& options() const { return options_; }
  /// Most samples per ray after each pass.
  const std::vector<std::int64_t>& per_ray() const { return per_ray_; }
  const std::vector<std::int64_t>& rendered_per_ray() const { return rendered_per_ray_; }
  /// Of the CPU's lanes.
  std::int64_t tile_rays() const { return options_.tile_rays; }
  /// Of training; null where nothing is corrected.
  const CameraCorrections<Real>* cameras() const { return cameras_ ? &*cameras_ : nullptr; }
  bool has_semantics() const { return passes_.back().parts().head != nullptr; }

  Executor<Real>& executor() const { return *executor_; }
  LaneExecutor<Real>& lanes() const { return *lanes_; }
  void run_on(std::unique_ptr<Executor<Real>> executor);

  /// Derived tensors of the store from learned ones.
  void derive(std::int64_t step);
  BatchScales scales_of(const RayBatch& batch) const;
  /// Means and total of a batch's sums.
  StepLosses means_of(const StepLosses& sums, const BatchScales& scales) const;
  /// Throws Error(failure) naming the first loss, or element of a gradient, value, moment or state, that is not finite
  /// or too large for an update. Of tables and large states a step looks at a window.
  void require_sound(std::int64_t step, const StepLosses& losses) const;
  /// The tensor behind a value that is not finite: one that holds such a value, else the largest value of all if it is
  /// out of all proportion; "": none.
  std::string suspect_tensor() const;

 private:
  std::vector<std::int64_t> per_ray_, rendered_per_ray_;
  PipelineOptions options_;
  ParamStore<Real> store_;
  std::vector<Pass<Real>> passes_;
  std::optional<CameraCorrections<Real>> cameras_;
  std::unique_ptr<LaneExecutor<Real>> lanes_;
  std::unique_ptr<Executor<Real>> other_;  // than the lanes
  Executor<Real>* executor_ = nullptr;
};

/// "row 3, column 1".
template <class Real>
std::string element_text(const Tensor<Real>& tensor, std::int64_t element);

/// The options with the tiles and lanes that they leave open.
template <class Real>
PipelineOptions settled(PipelineOptions options, const std::vector<PassParts<Real>>& passes);

}  // namespace semfield
