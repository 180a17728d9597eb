// The walk of a training step through the passes, for the rays of a tile or of a whole batch: forward, losses,
// backward. Pass after pass is written here once; what differs between a CPU and a GPU is the executor's.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "model/camera_corrections.h"
#include "model/losses/loss_list.h"
#include "model/losses/semantic_cross_entropy.h"
#include "model/pass.h"

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

/// The arrays of a batch in one block, in the order of each_array, each on 256 bytes.
class BatchLayout {
 public:
  BatchLayout() = default;
  /// Of batches of the shape of `like`, whose views need no data.
  explicit BatchLayout(const RayBatch& like);
  bool fits(const RayBatch& batch) const;
  std::size_t bytes() const { return bytes_; }
  /// Copies the arrays of a batch in host memory into a block.
  void write(const RayBatch& batch, std::byte* block) const;
  /// The batch in a block; its counts of tiles are host memory, those of `like`.
  RayBatch in(const std::byte* block, Device device) const;

 private:
  BatchShape shape_;
  std::vector<std::int64_t> label_only_;
  std::vector<std::size_t> at_;  // where the arrays that are there begin
  std::size_t bytes_ = 0;
};

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
  std::uint32_t dense_passes =
      0;  ///< bit p: pass p met density somewhere. Without it nothing of the pass gets a gradient
};

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
  std::int64_t reached_room = 0;                     ///< PassRequest::reached_room
  std::int64_t room = 0;                             ///< PassRequest::room
};

/// ctx.workspace holds everything of the walk; the caller's scope gives it back. per_ray: most samples per ray after
/// each pass.
template <class Real>
void train_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                const TrainedRays<Real>& rays, const StepContext& ctx, StepExecutor<Real>& executor);

}  // namespace semfield
