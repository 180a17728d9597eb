#include "cuda/pass.h"

#include <algorithm>

#include "core/check.h"
#include "cuda/hidden_channels.h"
#include "cuda/layers.h"
#include "cuda/losses.h"

namespace semfield::cuda {

namespace {

constexpr std::int64_t kDensityBatch = std::int64_t{1} << 18;  // positions a density query evaluates at once

class LearnsAnything final : public ParamDeclarer {
 public:
  int tensor(TensorSpec spec) override {
    found = found || spec.role == TensorRole::dense || spec.role == TensorRole::sparse;
    return count_++;
  }
  bool found = false;

 private:
  int count_ = 0;
};

Launch with_live_rows(const std::int32_t* live_rows) {
  Launch next = launch();
  next.live_rows = live_rows;
  return next;
}

}  // namespace

Pass::Pass(PassParts<float> parts, const RenderRules& rules, Precision head_precision, Store& store)
    : parts_(std::move(parts)), rules_(rules), store_(&store) {
  sampler_ = store.add(*parts_.sampler);
  position_ = store.add(*parts_.position);
  LearnsAnything learns;
  parts_.position->declare(learns);
  encoder_learns_ = learns.found;
  if (parts_.direction) direction_ = store.add(*parts_.direction);
  field_ = store.add(*parts_.field);
  if (!parts_.head) return;
  head_tensors_ = store.add(*parts_.head);
  head_.emplace(*parts_.head, head_precision);
  if (parts_.branch) branch_.emplace(*parts_.branch, store);
}

void Pass::derive(const StepContext& ctx) const {
  parts_.sampler->derive(ctx, store_->tensors(sampler_));
  parts_.position->derive(ctx, store_->tensors(position_));
  parts_.field->derive(ctx, store_->tensors(field_));
  if (branch_) branch_->derive(ctx);
}

void Pass::derive_backward(const StepContext& ctx) const {
  parts_.position->derive_backward(ctx, store_->tensors(position_));
  parts_.field->derive_backward(ctx, store_->tensors(field_));
  if (branch_) branch_->derive_backward(ctx);
}

DensityRule Pass::density_rule(const StepContext& ctx) const {
  DensityRule rule;
  rule.activation = rules_.activation;
  rule.bias = rules_.density_bias;
  rule.first_ray = ctx.first_ray;
  if (!ctx.training || rules_.density_noise <= 0) return rule;
  rule.deviation = rules_.density_noise;
  rule.random = ctx.random("density_noise");
  return rule;
}

Trace Pass::forward(const StepContext& ctx, const Rays<float>& rays, const Proposal<float>* previous,
                    std::int64_t previous_per_ray, std::int64_t semantic_rays, bool colors) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t ray_count = rays.origin.rows;
  const std::int64_t rows = parts_.sampler->capacity(ray_count, previous_per_ray);
  Trace trace;
  trace.samples.t = arena.take<float>(rows, 1);
  trace.samples.delta = arena.take<float>(rows, 1);
  trace.samples.ray_of_sample = arena.take<std::int32_t>(rows, 1);
  trace.samples.first = arena.take<std::int32_t>(ray_count + 1, 1);
  trace.weight = arena.take<float>(rows, 1);
  parts_.sampler->sample(ctx, store_->tensors(sampler_), rays, previous, trace.samples);

  const LaunchScope live(with_live_rows(trace.samples.first.data + ray_count));
  trace.x = arena.take<double>(rows, 3);
  locate(rays, trace.samples, parts_.domain, trace.x);
  if (parts_.direction) {
    const LaunchScope all_rays(with_live_rows(nullptr));
    trace.direction = arena.take<float>(ray_count, parts_.direction->traits().out_dims);
    parts_.direction->forward(ctx, store_->tensors(direction_), rays.direction, trace.direction);
  }
  trace.encoded = arena.take<float>(rows, parts_.position->traits().out_dims);
  parts_.position->forward(ctx, store_->tensors(position_), trace.x, trace.encoded);

  trace.semantic_rays = head_ ? semantic_rays : 0;
  trace.semantic_samples = std::min(rows, trace.semantic_rays * parts_.sampler->capacity(1, previous_per_ray));
  trace.out.sigma = arena.take<float>(rows, 1);
  if (colors) trace.out.rgb = arena.take<float>(rows, 3);
  trace.sigma = arena.take<float>(rows, 1);
  if (trace.semantic_rays > 0 && wants_feature())
    trace.out.feature = arena.take<float>(rows, parts_.field->traits().feature_dims);
  if (ctx.training) {
    const std::size_t bytes = parts_.field->saved_bytes(rows, ray_count);
    trace.saved = Saved(arena.take_bytes(bytes), bytes);
  }
  {
    FeatureExchange features;
    Launch sharing = launch();
    if (trace.semantic_rays > 0 && !branch_ && head_->rounds() && rules_.deferred_class_layer) {
      const std::int32_t width = trace.out.feature.cols, hidden = head_->hidden_width();
      __nv_bfloat16* const room = arena.take<__nv_bfloat16>(rows, std::max(width, hidden)).data;
      features.room = View<__nv_bfloat16>(room, rows, width, width, trace.sigma.device);
      features.layer = head_->hidden_layer(store_->tensors(head_tensors_));
      features.layer.hidden = View<__nv_bfloat16>(room, trace.semantic_samples, hidden, hidden, trace.sigma.device);
      sharing.features = &features;
    }
    const LaunchScope scope(sharing);
    parts_.field->forward(ctx, store_->tensors(field_), {trace.encoded, trace.direction, trace.samples.ray_of_sample},
                          trace.out, trace.saved);
    trace.rounded_feature = features.feature;
    if (features.hidden_is_done) trace.rounded_hidden = features.layer.hidden;
  }
  density_forward(density_rule(ctx), &trace.samples, trace.out.sigma, trace.sigma);
  if (colors) trace.color = arena.take<float>(ray_count, 3);
  trace.depth = arena.take<float>(ray_count, 1);
  trace.opacity = arena.take<float>(ray_count, 1);
  composite(ctx, trace);
  if (branch_ && trace.semantic_rays > 0 && !ctx.training) branch_forward(ctx, rays, trace);
  return trace;
}

CompositeIn<float> Pass::composite_in(const Trace& trace) const {
  CompositeIn<float> in;
  in.samples = &trace.samples;
  in.sigma = trace.sigma;
  in.rgb = trace.out.rgb;
  in.far = rules_.far;
  in.background = rules_.background;
  return in;
}

void Pass::composite(const StepContext& ctx, Trace& trace) const {
  Workspace& arena = *ctx.workspace;
  CompositeIn<float> in = composite_in(trace);
  CompositeOut<float> out;
  out.color = trace.color;
  out.depth = trace.depth;
  out.opacity = trace.opacity;
  out.weight = trace.weight;
  if (trace.semantic_rays == 0 || branch_) {  // a branch follows the weights
    composite_forward(in, out);
    return;
  }
  const Tensors<float> tensors = store_->tensors(head_tensors_);
  const std::int64_t rows = trace.semantic_samples;
  const View<const float> share = trace.opacity.row_range(0, trace.semantic_rays);
  trace.ray_hidden = arena.take<float>(trace.semantic_rays, head_->hidden_width());
  trace.logits = arena.take<float>(trace.semantic_rays, head_->classes());
  if (!trace.rounded_feature.empty()) {
    trace.rounded_hidden = arena.take<__nv_bfloat16>(rows, head_->hidden_width());
    head_->hidden_forward(arena, tensors, trace.rounded_feature.row_range(0, rows), trace.rounded_hidden);
  }
  if (!trace.rounded_hidden.empty()) {
    composite_forward(in, out);
    hidden_forward<__nv_bfloat16>(trace.samples, trace.weight, trace.rounded_hidden, trace.ray_hidden);
    head_->class_forward(arena, tensors, trace.ray_hidden, share, trace.logits);
    return;
  }
  trace.hidden = arena.take<float>(rows, head_->hidden_width());
  head_->hidden_forward(arena, tensors, trace.out.feature.row_range(0, rows), trace.hidden);
  if (rules_.deferred_class_layer) {
    in.hidden = trace.hidden;
    out.hidden = trace.ray_hidden;
    composite_forward(in, out);
    head_->class_forward(arena, tensors, trace.ray_hidden, share, trace.logits);
  } else {
    trace.sample_logits = arena.take<float>(rows, head_->classes());
    head_->class_forward(arena, tensors, trace.hidden, {}, trace.sample_logits);
    in.hidden = trace.sample_logits;
    out.hidden = trace.logits;
    composite_forward(in, out);
  }
}

void Pass::backward(const StepContext& ctx, const Trace& trace, const RayGradients<float>& d,
                    View<const float> d_logits) const {
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const std::int64_t rows = trace.samples.count, ray_count = trace.samples.first.rows - 1;
  if (rows == 0) return;
  const LaunchScope live(with_live_rows(trace.samples.first.data + ray_count));
  const bool semantic = trace.semantic_rays > 0 && !d_logits.empty(), deferred = rules_.deferred_class_layer;
  SEMFIELD_CHECK(!semantic || !branch_, "gradients of a branch are branch_backward's");
  if (semantic && !trace.rounded_hidden.empty()) return backward_in_bf16(ctx, trace, d, d_logits);
  CompositeIn<float> in = composite_in(trace);
  CompositeOut<float> out;
  out.weight = trace.weight;
  CompositeGrad<float> grad;
  grad.color = d.color;
  grad.depth = d.depth;
  grad.weight = d.weight;
  View<float> d_per_sample;
  Tensors<float> head_tensors;
  if (semantic) {
    head_tensors = store_->tensors(head_tensors_);
    in.hidden = deferred ? trace.hidden : trace.sample_logits;
    grad.hidden = d_logits;
    grad.hidden_moves_density = !rules_.stop_gradient_to_density;
    d_per_sample = arena.take<float>(trace.semantic_samples, in.hidden.cols);
    if (deferred) {
      const View<float> d_ray_hidden = arena.take<float>(trace.semantic_rays, head_->hidden_width());
      const View<float> d_opacity = arena.take<float>(trace.semantic_rays, 1);
      head_->class_backward(arena, head_tensors, trace.ray_hidden, trace.opacity.row_range(0, trace.semantic_rays),
                            d_logits, d_ray_hidden, d_opacity);
      grad.hidden = d_ray_hidden;
      if (grad.hidden_moves_density) grad.opacity = d_opacity;
    }
  }
  const View<float> d_sigma = arena.take<float>(rows, 1), d_rgb = arena.take<float>(rows, 3);
  composite_backward(in, out, grad, d_sigma, d_rgb, d_per_sample);
  View<float> d_feature;
  if (semantic) {
    View<float> d_hidden = d_per_sample;
    if (!deferred) {
      d_hidden = arena.take<float>(trace.semantic_samples, head_->hidden_width());
      head_->class_backward(arena, head_tensors, trace.hidden, {}, d_per_sample, d_hidden, {});
    }
    d_feature = arena.take<float>(rows, trace.out.feature.cols);
    fill(d_feature.row_range(trace.semantic_samples, rows - trace.semantic_samples), 0.0F);
    head_->hidden_backward(arena, head_tensors, trace.out.feature.row_range(0, trace.semantic_samples), trace.hidden,
                           d_hidden, d_feature.row_range(0, trace.semantic_samples));
  }
  raw_density_backward(trace, d, d_sigma);
  field_backward(ctx, trace, {d_sigma, d_rgb, d_feature});
}

// The same where field and head exchange bf16: a quarter of the bytes between them.
void Pass::backward_in_bf16(const StepContext& ctx, const Trace& trace, const RayGradients<float>& d,
                            View<const float> d_logits) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t rows = trace.samples.count;
  const Tensors<float> tensors = store_->tensors(head_tensors_);
  const bool moves_density = !rules_.stop_gradient_to_density;
  const View<float> d_ray_hidden = arena.take<float>(trace.semantic_rays, head_->hidden_width());
  const View<float> d_opacity = arena.take<float>(trace.semantic_rays, 1);
  head_->class_backward(arena, tensors, trace.ray_hidden, trace.opacity.row_range(0, trace.semantic_rays), d_logits,
                        d_ray_hidden, d_opacity);
  const View<float> d_sigma = arena.take<float>(rows, 1), d_rgb = arena.take<float>(rows, 3);
  const bool by_field = trace.rounded_feature.empty();  // the hidden layer
  const View<__nv_bfloat16> d_hidden = arena.take<__nv_bfloat16>(
      by_field ? blocked_rows(trace.semantic_samples) : trace.semantic_samples, head_->hidden_width());
  HiddenBackward<__nv_bfloat16> hidden;
  hidden.weight = trace.weight;
  hidden.hidden = trace.rounded_hidden;
  hidden.d_out = d_ray_hidden;
  if (moves_density) hidden.dots = d_sigma;
  hidden.d_hidden = d_hidden;
  hidden.blocked = by_field;
  hidden.relu_output = true;
  hidden_backward(trace.samples, hidden);
  CompositeOut<float> out;
  out.weight = trace.weight;
  CompositeGrad<float> grad;
  grad.color = d.color;
  grad.depth = d.depth;
  grad.weight = d.weight;
  if (moves_density) grad.opacity = d_opacity;
  composite_backward(composite_in(trace), out, grad, d_sigma, d_rgb, {}, moves_density ? trace.semantic_rays : 0);
  FeatureExchange features;
  if (by_field) {
    features.layer = head_->hidden_layer(tensors);
    features.layer.hidden = trace.rounded_hidden;
    features.layer.d_hidden = d_hidden.data;
  } else {
    const View<__nv_bfloat16> d_feature = arena.take<__nv_bfloat16>(trace.semantic_samples, trace.rounded_feature.cols);
    head_->hidden_backward(arena, tensors, trace.rounded_feature.row_range(0, trace.semantic_samples), d_hidden,
                           d_feature);
    features.d_feature = d_feature;
  }
  raw_density_backward(trace, d, d_sigma);
  Launch sharing = launch();
  sharing.features = &features;
  const LaunchScope scope(sharing);
  field_backward(ctx, trace, {d_sigma, d_rgb, {}});
}

void Pass::raw_density_backward(const Trace& trace, const RayGradients<float>& d, View<float> d_sigma) const {
  if (!d.sigma.empty()) add_rows<float, float>(d.sigma, d_sigma);
  density_backward(rules_.activation, trace.out.sigma, d_sigma, d_sigma);
}

void Pass::field_backward(const StepContext& ctx, const Trace& trace, const FieldGrad<float>& grad) const {
  View<float> d_encoded;
  if (encoder_learns_) d_encoded = ctx.workspace->take<float>(trace.encoded.rows, trace.encoded.cols);
  FieldOut<float> out = trace.out;
  if (grad.feature.empty()) out.feature = {};
  parts_.field->backward(ctx, store_->tensors(field_), {trace.encoded, trace.direction, trace.samples.ray_of_sample},
                         out, grad, trace.saved, d_encoded);
  if (encoder_learns_) parts_.position->backward(ctx, store_->tensors(position_), trace.x, d_encoded, {});
}

void Pass::density(const StepContext& ctx, View<const double> positions, View<float> sigma) const {
  Workspace& arena = *ctx.workspace;
  const LaunchScope all(with_live_rows(nullptr));
  DensityRule rule = density_rule(ctx);
  rule.deviation = 0;
  for (std::int64_t begin = 0; begin < positions.rows; begin += kDensityBatch) {
    const std::int64_t count = std::min(kDensityBatch, positions.rows - begin);
    const Workspace::Scope scope(arena);
    const View<double> x = arena.take<double>(count, 3);
    map_positions(positions.row_range(begin, count), parts_.domain, x);
    const View<float> encoded = arena.take<float>(count, parts_.position->traits().out_dims);
    parts_.position->forward(ctx, store_->tensors(position_), x, encoded);
    const View<float> raw = arena.take<float>(count, 1);
    FieldIn<float> in;
    in.position = encoded;
    FieldOut<float> out;
    out.sigma = raw;
    parts_.field->forward(ctx, store_->tensors(field_), in, out, {});
    density_forward(rule, nullptr, raw, sigma.row_range(begin, count));
  }
}

void Pass::observe(const StepContext& ctx) const {
  if (!parts_.sampler->traits().observes) return;
  parts_.sampler->observe(
      ctx, store_->tensors(sampler_),
      [this, &ctx](View<const double> positions, View<float> sigma) { density(ctx, positions, sigma); });
}

}  // namespace semfield::cuda
