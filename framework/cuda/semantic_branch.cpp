#include "cuda/semantic_branch.h"

#include "cuda/rendering.h"

namespace semfield::cuda {

namespace {

FieldIn<float> field_in(const SemanticBranchTrace<float>& trace) {
  FieldIn<float> in;
  in.position = trace.input;
  in.ray_of_sample = trace.samples.ray_of_sample;
  return in;
}

Rays<float> first_rays(const Rays<float>& rays, std::int64_t count) {
  return {rays.origin.row_range(0, count), rays.direction.row_range(0, count), rays.near_far.row_range(0, count)};
}

Dropout dropout(const StepContext& ctx, double share) { return {ctx.random(kBranchDropout), ctx.first_ray, share}; }

}  // namespace

Launch kept_rows(const Samples<float>& kept) {
  Launch next = launch();
  next.live_rows = kept.first.data + kept.first.rows - 1;
  next.features = nullptr;
  return next;
}

Branch::Branch(const SemanticBranchParts<float>& parts, Store& store) : parts_(parts), store_(&store) {
  position_ = store.add(*parts.position);
  field_ = store.add(*parts.field);
}

void Branch::derive(const StepContext& ctx) const {
  parts_.position->derive(ctx, store_->tensors(position_));
  parts_.field->derive(ctx, store_->tensors(field_));
}

void Branch::derive_backward(const StepContext& ctx) const {
  parts_.position->derive_backward(ctx, store_->tensors(position_));
  parts_.field->derive_backward(ctx, store_->tensors(field_));
}

SemanticBranchTrace<float> Branch::forward(const StepContext& ctx, const Rays<float>& rays,
                                           const Samples<float>& samples, View<const float> weight,
                                           View<const float> feature, std::int64_t semantic_rays,
                                           std::int64_t most) const {
  Workspace& arena = *ctx.workspace;
  SemanticBranchTrace<float> trace;
  trace.samples.t = arena.take<float>(most, 1);
  trace.samples.delta = arena.take<float>(most, 1);
  trace.samples.ray_of_sample = arena.take<std::int32_t>(most, 1);
  trace.samples.first = arena.take<std::int32_t>(semantic_rays + 1, 1);
  trace.samples.count = most;
  trace.source = arena.take<std::int32_t>(most, 1);
  trace.weight = arena.take<float>(most, 1);
  trace.share = arena.take<float>(semantic_rays, 1);
  keep_samples(samples, weight, static_cast<float>(parts_.rules.least_weight), trace);

  const LaunchScope live(kept_rows(trace.samples));
  const std::int32_t encoded = parts_.position->traits().out_dims;
  const View<const float> read = parts_.rules.reads_feature ? feature : View<const float>();
  trace.input = arena.take<float>(most, encoded + (read.empty() ? 0 : read.cols));
  trace.out.feature = trace.feature = arena.take<float>(most, parts_.field->traits().feature_dims);
  if (ctx.training) {
    const std::size_t bytes = parts_.field->saved_bytes(most, semantic_rays);
    trace.saved = Saved(arena.take_bytes(bytes), bytes);
    if (parts_.rules.dropout > 0) trace.feature = arena.take<float>(most, trace.out.feature.cols);
  }
  const Workspace::Scope scope(arena);
  const View<double> x = arena.take<double>(most, 3);
  locate(first_rays(rays, semantic_rays), trace.samples, parts_.domain, x);
  const View<float> position = arena.take<float>(most, encoded);
  parts_.position->forward(ctx, store_->tensors(position_), x, position);
  join_inputs(trace, position, read);
  parts_.field->forward(ctx, store_->tensors(field_), field_in(trace), trace.out, trace.saved);
  if (trace.feature.data != trace.out.feature.data)
    drop_out(dropout(ctx, parts_.rules.dropout), trace.samples, trace.out.feature, trace.feature);
  return trace;
}

void Branch::backward(const StepContext& ctx, const SemanticBranchTrace<float>& trace, View<float> d_feature) const {
  const LaunchScope live(kept_rows(trace.samples));
  if (trace.feature.data != trace.out.feature.data)
    drop_out(dropout(ctx, parts_.rules.dropout), trace.samples, d_feature, d_feature);
  FieldGrad<float> grad;
  grad.feature = d_feature;
  parts_.field->backward(ctx, store_->tensors(field_), field_in(trace), trace.out, grad, trace.saved, {});
}

}  // namespace semfield::cuda
