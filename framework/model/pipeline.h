// The whole differentiable renderer: passes over tiles of rays, losses, and gradients that do not depend on threads.
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "classes/class_table.h"
#include "core/work_scope.h"
#include "losses/semantic_cross_entropy.h"
#include "model/opacity_resolution.h"
#include "model/param_store.h"
#include "model/pass.h"
#include "model/ray_batch.h"
#include "model/ray_guard.h"
#include "model/train_rays.h"

namespace semfield {

struct PipelineOptions {
  RenderRules rules;
  std::uint64_t seed = 1;
  int lanes = 8;                  ///< gradient slots; the sum's order, so part of a run's identity
  std::int64_t tile_rays = 0;     ///< 0: from the samplers' capacities, never from the thread count
  double semantic_weight = 0.04;  ///< lambda [Zhi21, Eq. 7]
  SemanticNormalisation normalisation = SemanticNormalisation::mean_labelled;
  std::vector<float> class_weight;  ///< [C] or empty
  LossList losses;                  ///< terms beside colour and semantics
  WorkSettings work;                ///< threads and matrix products of every call
  bool head_on_all_rays =
      false;  ///< run the head on unlabelled rays too (their gradient is exactly 0): the leave-out's pair
};

/// Rays to render and where results go; R rows each, empty = not wanted.
template <class Real>
struct RenderJob {
  View<const double> origin, direction, near_far;
  View<const std::int16_t> truth;      ///< true classes; only to fill truth_probability
  View<Real> color;                    ///< [R, 3]
  View<Real> depth;                    ///< [R, 1] metres along the ray, not divided by opacity
  View<Real> opacity;                  ///< [R, 1]
  View<std::int16_t> label;            ///< [R, 1] argmax class
  View<Real> entropy;                  ///< [R, 1] nats
  View<Real> confidence;               ///< [R, 1] largest class probability
  View<Real> truth_probability;        ///< [R, 1] of the true class; 0 where void
  View<OpacityResolution> resolution;  ///< [R, 1]
  double footprint_per_m = 0;          ///< width of a pixel at a distance of 1 m, metres; for `resolution`
};

class DeviceBackend;

template <class Real>
class Pipeline {
 public:
  Pipeline(std::vector<PassParts<Real>> passes, PipelineOptions options, bool trainable);

  ParamStore<Real>& store() { return store_; }
  const ParamStore<Real>& store() const { return store_; }
  const std::vector<Pass<Real>>& passes() const { return passes_; }
  const PipelineOptions& options() const { return options_; }
  std::int64_t tile_rays() const { return tile_rays_; }
  bool has_semantics() const { return passes_.back().parts().head != nullptr; }

  /// Derived tensors from learned ones: after construction, loading, and every optimiser step.
  void derive(std::int64_t step);
  /// Losses of the batch and dL/dtheta in the store's main gradients (which must be zero on entry). A value of a ray
  /// that is not finite throws RayFault; gradients are then anything, and ParamStore::clear_gradients is due.
  StepLosses gradients(std::int64_t step, const RayBatch& batch);
  /// After a step that failed: takes its rays one by one and gives the first that throws, or whose own gradient is not
  /// finite, with its number in the batch; none when only their sum fails. Leaves every gradient zero.
  std::optional<RayFault> find_fault(std::int64_t step, const RayBatch& batch);
  /// What the summed semantic loss of the batch is divided by; 0: the batch has no label.
  double batch_normaliser(const RayBatch& batch) const;
  /// From now on render and density are the device's work (null: this processor's). Borrowed.
  void attach(DeviceBackend* device) { device_ = device; }
  /// Tensors of a semantic head.
  bool is_semantic(const Tensor<Real>& tensor) const;
  /// Lets samplers refresh their state; calls derive() first.
  void observe(std::int64_t step);
  /// Renders without jitter or noise; the same bits for any grouping of rays into calls.
  void render(const RenderJob<Real>& job);
  /// sigma [N, 1] of the last pass, after activation, 1/m, at world positions [N, 3]; the same bits for any grouping of
  /// positions into calls. Uses the lanes' scratch: not beside another call.
  void density(View<const double> positions, View<Real> sigma) const;

  /// Scratch of all lanes for a batch, from the samplers' capacities: an upper bound, known before step 0.
  std::size_t predicted_workspace_bytes(std::int64_t rays) const;
  /// Scratch memory of all lanes: high-water mark, and how often it grew.
  std::size_t workspace_bytes() const;
  std::int64_t workspace_growths() const;
  std::string status() const { return passes_.back().status(); }

 private:
  struct Lane {
    Workspace arena;
    std::vector<EncoderInbox<Real>> inbox;  // one a pass
  };
  // A step's samples drawn before the first is evaluated, all rows of a lane's tiles side by side: tables of an encoder
  // are then read, and written, for thousands of rows at a time, level by level, and not for one small tile after the
  // other. Vectors only grow.
  struct Ahead {
    std::vector<Real> t, delta;                      // [tiles * capacity of a tile]
    std::vector<std::int32_t> ray_of_sample, first;  // [tiles * capacity], [tiles * (tile_rays + 1)]
    std::vector<SampledTile<Real>> tiles;            // [tiles]
    std::vector<std::int64_t> row;                   // [tiles] of its first sample in what follows
    std::vector<double> x;                           // [M, 3]
    std::vector<Real> encoded, d_encoded;            // [M, Dp]
    std::int64_t rows = 0;
    std::size_t bytes() const;
  };
  bool draws_ahead() const { return passes_.size() == 1 && passes_[0].scatters(); }
  void draw_ahead(std::int64_t step, const RayBatch& batch, std::int64_t tiles);
  void scatter(std::int64_t step);
  StepContext context(std::int64_t step, bool training, int lane, std::int64_t first_ray) const;
  static constexpr std::int64_t kAlone = -1;  // a tile's number: rays that are no tile of the step
  struct TileRange {
    std::int64_t begin, count, number;
  };
  // What the sums of a batch are divided by.
  struct BatchScales {
    double semantic = 0;
    LossScales terms;
  };
  BatchScales scales_of(std::int64_t step, const RayBatch& batch) const;
  StepLosses train_tile(std::int64_t step, int lane, const RayBatch& batch, const TileRange& tile,
                        const BatchScales& scales);
  class TileExecutor;
  void render_tile(int lane, const RenderJob<Real>& job, std::int64_t begin, std::int64_t count);

  PipelineOptions options_;
  ParamStore<Real> store_;
  std::vector<Pass<Real>> passes_;
  std::vector<std::int64_t> per_ray_;  // most samples a ray after each pass
  std::int64_t tile_rays_ = 0;
  std::vector<std::unique_ptr<Lane>> lanes_;
  std::vector<StepLosses> tile_losses_;
  Ahead ahead_;
  DeviceBackend* device_ = nullptr;
};

extern template class Pipeline<float>;
extern template class Pipeline<double>;

}  // namespace semfield
