// The walk of a training step through the passes, for the rays of a tile or of a whole batch: forward, losses,
// backward. Pass after pass is written here once; what differs between a CPU and a GPU is the executor's.
#pragma once

#include <vector>

#include "execution/ray_batch.h"
#include "losses/semantic_cross_entropy.h"
#include "model/camera_corrections.h"
#include "model/pass.h"

namespace semfield {

/// What a device does with the losses of a pass and with the gradients at its encoder. Sums of losses stay with the
/// executor: on a device they are read when a step is waited for.
template <class Real>
class StepExecutor {
 public:
  virtual ~StepExecutor() = default;

  /// Samples of the first pass that were drawn before this call, with their encoded positions; null: forward draws
  /// them.
  virtual const SampledTile<Real>* drawn() const { return nullptr; }
  /// The summed squares of color - target [N, 3] each, and their gradient.
  virtual void color_loss(std::size_t pass, Workspace& arena, View<const Real> color, View<const float> target,
                          View<Real> d_color) = 0;
  /// The cross-entropy of logits [N, C], and lambda times its gradient.
  virtual void semantic_loss(std::size_t pass, Workspace& arena, View<const Real> logits,
                             const SemanticTargets& targets, View<Real> d_logits) = 0;
  /// Bits of the losses of the list that work in this step, and the sums and gradients of `which` of them, added to
  /// `gradients`.
  virtual const LossList& losses() const = 0;
  virtual std::uint32_t active_losses() const = 0;
  virtual void add_losses(std::size_t pass, Workspace& arena, std::uint32_t which, const RayTargets& targets,
                          const RayValues<Real>& values, const RayGradients<Real>& gradients) = 0;
  /// Counts samples, and whether any has density.
  virtual void count(std::size_t pass, const PassTrace<Real>& trace) = 0;
  /// Memory for the gradient at the outputs of a position encoder that learns, [M, Dp], and what becomes of it.
  virtual View<Real> encoded_gradient(std::size_t pass, const PassTrace<Real>& trace, Workspace& arena) = 0;
  virtual void use_encoded_gradient(std::size_t pass, const PassTrace<Real>& trace, const StepContext& ctx,
                                    View<Real> d_encoded) = 0;
  /// Between begin and end the semantic branch of a pass is computed, with the context that begin gives; nothing behind
  /// join runs before it is done.
  virtual StepContext begin_branch(const StepContext& ctx) { return ctx; }
  virtual void end_branch() {}
  virtual void join_branch() {}
  /// All gradients of a pass's tensors are queued or made; the next pass adds nothing to them.
  virtual void pass_done(std::size_t) {}
};

/// Rays of a step and how they are walked.
template <class Real>
struct TrainedRays {
  RayBatch batch;  ///< these rays alone; where poses are corrected, as their cameras move them
  const CameraCorrections<Real>* cameras = nullptr;  ///< null: no camera is corrected
  int lane = kMainGradient;                          ///< where gradients of parameters go
  std::int64_t semantic_rays = 0;                    ///< the first of them, which get logits
  std::int64_t first_color = 0;                      ///< the first ray that has a part in the colour loss
  std::int64_t room = 0;                             ///< PassRequest::room
};

/// ctx.workspace holds everything of the walk; the caller's scope gives it back. per_ray: most samples per ray after
/// each pass.
template <class Real>
void train_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                const TrainedRays<Real>& rays, const StepContext& ctx, StepExecutor<Real>& executor);

}  // namespace semfield
