// The semantic head of a pass behind a branch of its own: logits of the kept samples, and their gradients.
#include "model/pass.h"

namespace semfield {

template <class Real>
void Pass<Real>::branch_forward(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                PassTrace<Real>& trace) const {
  Workspace& arena = *ctx.workspace;
  const Tensors<Real> head = head_tensors(lane);
  trace.branch = branch_->forward(ctx, lane, rays, trace.samples, trace.weight, trace.out.feature, trace.semantic_rays,
                                  trace.semantic_samples);
  const SemanticBranchTrace<Real>& branch = trace.branch;
  trace.hidden = arena.take<Real>(branch.samples.count, parts_.head->hidden_width());
  {
    const LiveRows<Real> live(*stages_, branch.samples);
    stages_->guard(place(ctx, branch.samples), Guarded::semantic_feature, branch.feature);
    parts_.head->hidden_forward(ctx, head, branch.feature, trace.hidden);
    if (!rules_.deferred_class_layer) {
      trace.sample_logits = arena.take<Real>(branch.samples.count, parts_.head->classes());
      parts_.head->class_forward(ctx, head, trace.hidden, {}, trace.sample_logits);
    }
  }
  if (rules_.deferred_class_layer) {
    stages_->sum_by_weight(branch.samples, branch.weight, trace.hidden, trace.ray_hidden);
    parts_.head->class_forward(ctx, head, trace.ray_hidden, branch.share, trace.logits);
  } else {
    stages_->sum_by_weight(branch.samples, branch.weight, trace.sample_logits, trace.logits);
  }
  stages_->guard(place(ctx, trace.samples), Guarded::logits, trace.logits);
}

template <class Real>
void Pass<Real>::branch_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace,
                                 View<const Real> d_logits) const {
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const Tensors<Real> head = head_tensors(lane);
  const SemanticBranchTrace<Real>& branch = trace.branch;
  const std::int64_t kept = branch.samples.count;
  const View<Real> d_hidden = arena.take<Real>(kept, parts_.head->hidden_width());
  if (rules_.deferred_class_layer) {
    const View<Real> d_ray_hidden = arena.take<Real>(trace.semantic_rays, parts_.head->hidden_width());
    parts_.head->class_backward(ctx, head, trace.ray_hidden, branch.share, d_logits, d_ray_hidden, {});
    stages_->sum_by_weight_backward(branch.samples, branch.weight, d_ray_hidden, d_hidden);
  } else {
    const View<Real> d_sample_logits = arena.take<Real>(kept, parts_.head->classes());
    stages_->sum_by_weight_backward(branch.samples, branch.weight, d_logits, d_sample_logits);
    const LiveRows<Real> live(*stages_, branch.samples);
    parts_.head->class_backward(ctx, head, trace.hidden, {}, d_sample_logits, d_hidden, {});
  }
  if (kept == 0) return;
  const View<Real> d_feature = arena.take<Real>(kept, branch.feature.cols);
  {
    const LiveRows<Real> live(*stages_, branch.samples);
    parts_.head->hidden_backward(ctx, head, branch.feature, trace.hidden, d_hidden, d_feature);
  }
  branch_->backward(ctx, lane, branch, d_feature);
}

#define SEMFIELD_INSTANTIATE(Real)                                                                              \
  template void Pass<Real>::branch_forward(const StepContext&, int, const Rays<Real>&, PassTrace<Real>&) const; \
  template void Pass<Real>::branch_backward(const StepContext&, int, const PassTrace<Real>&, View<const Real>) const;
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
