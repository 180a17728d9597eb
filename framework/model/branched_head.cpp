#include "model/branched_head.h"

#include "core/error.h"

namespace semfield {

template <class Real>
BranchedHead<Real>::BranchedHead(const Head<Real>& head, const BranchParts<Real>& branch, const BranchPlace& place,
                                 bool deferred, TensorStore<Real>& store, const Stages<Real>& stages)
    : head_(&head), branch_(&branch), place_(place), deferred_(deferred), store_(&store), stages_(&stages) {
  if (learns<Real>(*branch.position)) {
    throw Error(ErrorKind::config, "config.encoder.learned",
                "pass '" + place.pass + "': the position encoder of the branch '" + place.prefix +
                    "' has learned tensors, and the branch is to be smoother than such tables",
                "choose an encoder without learned tensors");
  }
  const LearningRule rule{branch.rules.learning_rate, branch.rules.weight_decay, place.semantic};
  head_tensors_ = store.add(place.prefix, head, rule);
  position_ = store.add(place.prefix + "/position", *branch.position, rule);
  field_ = store.add(place.prefix + "/field", *branch.field, rule);
}

template <class Real>
BranchTrace<Real> BranchedHead<Real>::branch_forward(const StepContext& ctx, int lane,
                                                     const BranchCall<Real>& call) const {
  Workspace& arena = *ctx.workspace;
  BranchTrace<Real> trace;
  trace.samples.first = arena.take<std::int32_t>(call.count + 1, 1);
  trace.share = arena.take<Real>(call.count, 1);
  stages_->keep(arena, *call.samples, call.weight, static_cast<Real>(branch_->rules.least_weight), call.most, trace);
  const std::int64_t kept = trace.samples.count;
  const LiveRows<Real> live(*stages_, trace.samples);
  const std::int32_t encoded = branch_->position->traits().out_dims;
  const View<const Real> read = branch_->rules.reads_feature ? call.feature : View<const Real>();
  trace.input = arena.take<Real>(kept, encoded + (read.empty() ? 0 : read.cols));
  take_outputs(ctx, kept, call.count, trace);
  if (kept == 0) return trace;
  const Workspace::Scope scope(arena);
  const View<double> x = arena.take<double>(kept, 3);
  const Rays<Real> seen{call.rays->origin.row_range(0, call.count), call.rays->direction.row_range(0, call.count),
                        call.rays->near_far.row_range(0, call.count)};
  stages_->locate({place_.pass, ctx.first_ray, &trace.samples}, seen, branch_->domain, x);
  const View<Real> position = arena.take<Real>(kept, encoded);
  branch_->position->forward(ctx, store_->tensors(position_, lane), x, position);
  stages_->join(trace, position, read);
  run_network(ctx, lane, trace);
  return trace;
}

template <class Real>
void BranchedHead<Real>::take_outputs(const StepContext& ctx, std::int64_t rows, std::int64_t rays,
                                      BranchTrace<Real>& trace) const {
  Workspace& arena = *ctx.workspace;
  trace.out.feature = trace.feature = arena.take<Real>(rows, branch_->field->traits().feature_dims);
  if (!ctx.training) return;
  const std::size_t bytes = branch_->field->saved_bytes(rows, rays);
  trace.saved = Saved(arena.take_bytes(bytes), bytes);
  if (branch_->rules.dropout > 0) trace.feature = arena.take<Real>(rows, branch_->field->traits().feature_dims);
}

template <class Real>
BranchTrace<Real> BranchedHead<Real>::forward_points(const StepContext& ctx, int lane, View<const Real> input) const {
  Workspace& arena = *ctx.workspace;
  BranchTrace<Real> trace;
  // Nothing writes it from here on.
  trace.input = {const_cast<Real*>(input.data), input.rows, input.cols, input.row_stride, input.device};
  trace.samples.count = input.rows;
  trace.samples.first = arena.take<std::int32_t>(input.rows + 1, 1);
  trace.samples.ray_of_sample = arena.take<std::int32_t>(input.rows, 1);
  stages_->count_up(trace.samples.first);
  stages_->count_up(trace.samples.ray_of_sample);
  take_outputs(ctx, input.rows, input.rows, trace);
  if (input.rows > 0) run_network(ctx, lane, trace);
  return trace;
}

template <class Real>
void BranchedHead<Real>::branch_backward(const StepContext& ctx, int lane, const BranchTrace<Real>& trace,
                                         View<Real> d_feature) const {
  if (trace.samples.count == 0) return;
  const LiveRows<Real> live(*stages_, trace.samples);
  if (drops_out(trace)) stages_->drop_out(dropout(ctx), trace.samples, d_feature, d_feature);
  branch_->field->backward(ctx, store_->tensors(field_, lane), field_in(trace), trace.out, {.feature = d_feature},
                           trace.saved, {});
}

template <class Real>
HeadTrace<Real> BranchedHead<Real>::forward(const StepContext& ctx, int lane, const BranchCall<Real>& call) const {
  Workspace& arena = *ctx.workspace;
  HeadTrace<Real> trace;
  trace.ray_hidden = arena.take<Real>(call.count, head_->hidden_width());
  trace.rows = arena.take<Real>(call.count, head_->width());
  trace.branch = branch_forward(ctx, lane, call);
  const BranchTrace<Real>& branch = trace.branch;
  trace.hidden = arena.take<Real>(branch.samples.count, head_->hidden_width());
  {
    const LiveRows<Real> live(*stages_, branch.samples);
    stages_->guard({place_.pass, ctx.first_ray, &branch.samples}, Guarded::semantic_feature, branch.feature);
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
  stages_->guard({place_.pass, ctx.first_ray, call.samples}, place_.semantic ? Guarded::logits : Guarded::channel,
                 trace.rows);
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
  branch_backward(ctx, lane, branch, d_feature);
}

template class BranchedHead<float>;
template class BranchedHead<double>;

}  // namespace semfield
