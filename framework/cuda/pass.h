// One pass over a batch of rays on the device: sample, encode, field, semantic head, composite; and the same backward.
// Twin of model/pass, for whole batches.
#pragma once

#include <memory>
#include <optional>

#include "cuda/head.h"
#include "cuda/rendering.h"
#include "cuda/store.h"
#include "model/pass.h"

namespace semfield::cuda {

class Pass {
 public:
  /// `parts` were built for the device; their tensors must follow in `store`.
  Pass(PassParts<float> parts, const RenderRules& rules, Precision head_precision, Store& store);

  const PassParts<float>& parts() const { return parts_; }
  std::int64_t capacity_per_ray(std::int64_t previous_per_ray) const {
    return parts_.sampler->capacity(1, previous_per_ray);
  }

  /// Everything of a batch, in ctx.workspace. The first `semantic_rays` rays get logits. trace.semantic_samples bounds
  /// the rows of their samples from above.
  PassTrace<float> forward(const StepContext& ctx, const Rays<float>& rays, const Proposal<float>* previous,
                           std::int64_t previous_per_ray, std::int64_t semantic_rays) const;
  /// Gradients from d_color [R, 3] and d_logits [semantic_rays, C] (empty: zero) into the store.
  void backward(const StepContext& ctx, const PassTrace<float>& trace, View<const float> d_color,
                View<const float> d_logits) const;

  void derive(const StepContext& ctx) const;
  void derive_backward(const StepContext& ctx) const;
  void observe(const StepContext& ctx) const;
  /// sigma [N, 1] after activation at world positions [N, 3].
  void density(const StepContext& ctx, View<const double> positions, View<float> sigma) const;

 private:
  void composite(const StepContext& ctx, PassTrace<float>& trace) const;
  DensityRule density_rule(const StepContext& ctx) const;

  PassParts<float> parts_;
  RenderRules rules_;
  Store* store_;
  std::optional<Head> head_;
  int sampler_ = 0, position_ = 0, direction_ = -1, field_ = 0, head_tensors_ = -1;
  bool encoder_learns_ = false;
};

}  // namespace semfield::cuda
