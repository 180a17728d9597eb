#include "model/branched_head.h"

namespace semfield {

template <class Real>
BranchedHead<Real>::BranchedHead(const Head<Real>& head, const BranchParts<Real>& branch, const BranchPlace& place,
                                 bool deferred, TensorStore<Real>& store, const Stages<Real>& stages)
    : head_(&head),
      store_(&store),
      stages_(&stages),
      pass_(place.pass),
      guarded_(place.semantic ? Guarded::logits : Guarded::channel),
      deferred_(deferred),
      component_(store.add(place.prefix, head, branch.rules.learning(place.semantic))),
      branch_(branch, place, store, stages) {}

template <class Real>
void BranchedHead<Real>::derive(const StepContext& ctx) const {
  head_->derive(ctx, store_->tensors(component_));
  branch_.derive(ctx);
}

template <class Real>
void BranchedHead<Real>::derive_backward(const StepContext& ctx) const {
  head_->derive_backward(ctx, store_->tensors(component_));
  branch_.derive_backward(ctx);
}

template <class Real>
HeadTrace<Real> BranchedHead<Real>::forward(const StepContext& ctx, int lane, const BranchCall<Real>& call) const {
  Workspace& arena = *ctx.workspace;
  HeadTrace<Real> trace;
  trace.ray_hidden = arena.take<Real>(call.count, head_->hidden_width());
  trace.rows = arena.take<Real>(call.count, head_->width());
  trace.branch = branch_.forward(ctx, lane, call);
  const BranchTrace<Real>& branch = trace.branch;
  trace.hidden = arena.take<Real>(branch.samples.count, head_->hidden_width());
  {
    const LiveRows<Real> live(*stages_, branch.samples);
    stages_->guard({pass_, ctx.first_ray, &branch.samples}, Guarded::semantic_feature, branch.feature);
    head_->hidden_forward(ctx, tensors(lane), branch.feature, trace.hidden);
    if (!deferred_) {
      trace.sample_rows = arena.take<Real>(branch.samples.count, head_->width());
      head_->output_forward(ctx, tensors(lane), trace.hidden, {}, trace.sample_rows);
    }
  }
  if (deferred_) {
    stages_->sum_by_weight(branch.samples, branch.weight, trace.hidden, trace.ray_hidden);
    head_->output_forward(ctx, tensors(lane), trace.ray_hidden, branch.share, trace.rows);
  } else {
    stages_->sum_by_weight(branch.samples, branch.weight, trace.sample_rows, trace.rows);
  }
  const LiveRows<Real> all_rays(*stages_, nullptr);
  stages_->guard({pass_, ctx.first_ray, call.samples}, guarded_, trace.rows);
  return trace;
}

template <class Real>
void BranchedHead<Real>::backward(const StepContext& ctx, int lane, const HeadTrace<Real>& trace,
                                  View<const Real> d_rows) const {
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const BranchTrace<Real>& branch = trace.branch;
  const std::int64_t kept = branch.samples.count;
  const View<Real> d_hidden = arena.take<Real>(kept, head_->hidden_width());
  if (deferred_) {
    const View<Real> d_ray_hidden = arena.take<Real>(trace.ray_hidden.rows, head_->hidden_width());
    head_->output_backward(ctx, tensors(lane), trace.ray_hidden, branch.share, d_rows, d_ray_hidden, {});
    stages_->sum_by_weight_backward(branch.samples, branch.weight, d_ray_hidden, d_hidden);
  } else {
    const View<Real> d_sample_rows = arena.take<Real>(kept, head_->width());
    stages_->sum_by_weight_backward(branch.samples, branch.weight, d_rows, d_sample_rows);
    const LiveRows<Real> live(*stages_, branch.samples);
    head_->output_backward(ctx, tensors(lane), trace.hidden, {}, d_sample_rows, d_hidden, {});
  }
  if (kept == 0) return;
  const View<Real> d_feature = arena.take<Real>(kept, branch.feature.cols);
  {
    const LiveRows<Real> live(*stages_, branch.samples);
    head_->hidden_backward(ctx, tensors(lane), branch.feature, trace.hidden, d_hidden, d_feature);
  }
  branch_.backward(ctx, lane, branch, d_feature);
}

template class BranchedHead<float>;
template class BranchedHead<double>;

}  // namespace semfield
