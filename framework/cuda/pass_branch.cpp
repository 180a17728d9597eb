// The semantic head of a pass behind a branch of its own, twin of model/pass_branch.
#include "cuda/hidden_channels.h"
#include "cuda/pass.h"

namespace semfield::cuda {

void Pass::branch_forward(const StepContext& ctx, const Rays<float>& rays, Trace& trace) const {
  Workspace& arena = *ctx.workspace;
  const Tensors<float> tensors = store_->tensors(head_tensors_);
  trace.branch = branch_->forward(ctx, rays, trace.samples, trace.weight, trace.out.feature, trace.semantic_rays,
                                  trace.semantic_samples);
  const SemanticBranchTrace<float>& branch = trace.branch;
  const std::int64_t most = branch.samples.count;
  trace.hidden = arena.take<float>(most, head_->hidden_width());
  trace.ray_hidden = arena.take<float>(trace.semantic_rays, head_->hidden_width());
  trace.logits = arena.take<float>(trace.semantic_rays, head_->classes());
  {
    const LaunchScope live(kept_rows(branch.samples));
    guard_finite(Stage::feature, branch.feature);
    head_->hidden_forward(arena, tensors, branch.feature, trace.hidden);
    if (!rules_.deferred_class_layer) {
      trace.sample_logits = arena.take<float>(most, head_->classes());
      head_->class_forward(arena, tensors, trace.hidden, {}, trace.sample_logits);
    }
  }
  if (!rules_.deferred_class_layer) {
    hidden_forward<float>(branch.samples, branch.weight, trace.sample_logits, trace.logits);
    return;
  }
  hidden_forward<float>(branch.samples, branch.weight, trace.hidden, trace.ray_hidden);
  head_->class_forward(arena, tensors, trace.ray_hidden, branch.share, trace.logits);
}

void Pass::branch_backward(const StepContext& ctx, const Trace& trace, View<const float> d_logits) const {
  Workspace& arena = *ctx.workspace;
  const Tensors<float> tensors = store_->tensors(head_tensors_);
  const SemanticBranchTrace<float>& branch = trace.branch;
  const std::int64_t most = branch.samples.count;
  const View<float> d_hidden = arena.take<float>(most, head_->hidden_width());
  HiddenBackward<float> sum;
  sum.weight = branch.weight;
  if (rules_.deferred_class_layer) {
    const View<float> d_ray_hidden = arena.take<float>(trace.semantic_rays, head_->hidden_width());
    const View<float> unused = arena.take<float>(trace.semantic_rays, 1);
    head_->class_backward(arena, tensors, trace.ray_hidden, branch.share, d_logits, d_ray_hidden, unused);
    sum.d_out = d_ray_hidden;
    sum.d_hidden = d_hidden;
    hidden_backward(branch.samples, sum);
  } else {
    const View<float> d_sample_logits = arena.take<float>(most, head_->classes());
    sum.d_out = d_logits;
    sum.d_hidden = d_sample_logits;
    hidden_backward(branch.samples, sum);
    const LaunchScope live(kept_rows(branch.samples));
    head_->class_backward(arena, tensors, trace.hidden, {}, d_sample_logits, d_hidden, {});
  }
  const View<float> d_feature = arena.take<float>(most, branch.feature.cols);
  {
    const LaunchScope live(kept_rows(branch.samples));
    head_->hidden_backward(arena, tensors, branch.feature, trace.hidden, d_hidden, d_feature);
  }
  branch_->backward(ctx, branch, d_feature);
}

}  // namespace semfield::cuda
