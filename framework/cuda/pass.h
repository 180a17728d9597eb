// One pass over a batch of rays on the device: sample, encode, field, semantic head, composite; and the same backward.
// Twin of model/pass, for whole batches.
#pragma once

#include <memory>
#include <optional>

#include "cuda/feature_exchange.h"
#include "cuda/head.h"
#include "cuda/rendering.h"
#include "cuda/semantic_branch.h"
#include "cuda/store.h"
#include "model/pass.h"

namespace semfield::cuda {

/// With a field that shares its feature in bf16 (feature_exchange.h) the hidden activations are bf16 too.
struct Trace : PassTrace<float> {
  View<const __nv_bfloat16> rounded_feature;  ///< [M, F]; empty: out.feature holds it, or the field kept it for itself
  View<__nv_bfloat16> rounded_hidden;         ///< [semantic_samples, H]
};

class Pass {
 public:
  /// `parts` were built for the device; their tensors must follow in `store`.
  Pass(PassParts<float> parts, const RenderRules& rules, Precision head_precision, Store& store);

  const PassParts<float>& parts() const { return parts_; }
  std::int64_t capacity_per_ray(std::int64_t previous_per_ray) const {
    return parts_.sampler->capacity(1, previous_per_ray);
  }

  /// Everything of a batch, in ctx.workspace. The first `semantic_rays` rays get logits. trace.semantic_samples bounds
  /// the rows of their samples from above. colors false: weights alone are wanted, for a later pass. In training a pass
  /// with a branch leaves the logits to branch_forward.
  Trace forward(const StepContext& ctx, const Rays<float>& rays, const Proposal<float>* previous,
                std::int64_t previous_per_ray, std::int64_t semantic_rays, bool colors = true) const;
  /// Gradients from d (an empty view but for color: zero) and d_logits [semantic_rays, C] (empty: zero, and with a
  /// branch) into the store.
  void backward(const StepContext& ctx, const Trace& trace, const RayGradients<float>& d,
                View<const float> d_logits) const;

  bool has_branch() const { return branch_.has_value(); }
  /// Logits of the semantic rays by way of the branch, and its gradients from them. Neither touches what backward
  /// does, so both may run beside it, with a workspace of their own.
  void branch_forward(const StepContext& ctx, const Rays<float>& rays, Trace& trace) const;
  void branch_backward(const StepContext& ctx, const Trace& trace, View<const float> d_logits) const;

  void derive(const StepContext& ctx) const;
  void derive_backward(const StepContext& ctx) const;
  void observe(const StepContext& ctx) const;
  /// sigma [N, 1] after activation at world positions [N, 3].
  void density(const StepContext& ctx, View<const double> positions, View<float> sigma) const;

 private:
  void composite(const StepContext& ctx, Trace& trace) const;
  bool wants_feature() const { return head_ && (!branch_ || parts_.branch->rules.reads_feature); }
  CompositeIn<float> composite_in(const Trace& trace) const;
  void backward_in_bf16(const StepContext& ctx, const Trace& trace, const RayGradients<float>& d,
                        View<const float> d_logits) const;
  void field_backward(const StepContext& ctx, const Trace& trace, const FieldGrad<float>& grad) const;
  /// From dL/d(sigma) of the compositor to that of the raw density, in its place.
  void raw_density_backward(const Trace& trace, const RayGradients<float>& d, View<float> d_sigma) const;
  DensityRule density_rule(const StepContext& ctx) const;

  PassParts<float> parts_;
  RenderRules rules_;
  Store* store_;
  std::optional<Head> head_;
  std::optional<Branch> branch_;
  int sampler_ = 0, position_ = 0, direction_ = -1, field_ = 0, head_tensors_ = -1;
  bool encoder_learns_ = false;
};

}  // namespace semfield::cuda
