#include "model/pass.h"

#include <algorithm>

#include "core/check.h"
#include "core/error.h"
#include "model/param_store.h"

namespace semfield {

template <class Real>
Pass<Real>::Pass(PassParts<Real> parts, const RenderRules& rules, TensorStore<Real>& store)
    : parts_(std::move(parts)), rules_(rules), store_(&store), stages_(parts_.stages) {
  const std::string& name = parts_.name;
  encoder_learns_ = declared_bytes<Real>(*parts_.position, 1, true).learns;
  if (parts_.direction && declared_bytes<Real>(*parts_.direction, 1, true).learns) {
    throw Error(
        ErrorKind::config, "config.encoder.learned",
        "pass '" + name +
            "': the direction encoder has learned tensors; directions are encoded once per ray without gradients",
        "choose a direction encoder without learned tensors");
  }
  sampler_ = store.add(name + "/sampler", *parts_.sampler);
  position_ = store.add(name + "/position", *parts_.position);
  if (parts_.direction) direction_ = store.add(name + "/direction", *parts_.direction);
  field_ = store.add(name + "/field", *parts_.field);
  if (parts_.head && parts_.branch) {
    branched_.emplace(*parts_.head, *parts_.branch, BranchPlace{name + "/semantic", name, true},
                      rules_.deferred_class_layer, store, *stages_);
  } else if (parts_.head) {
    head_ = store.add(name + "/semantic", *parts_.head, LearningRule{1, 0, true});
  }
  SEMFIELD_CHECK(parts_.heads.size() <= kMostHeads, "too many heads");
  for (const HeadParts<Real>& one : parts_.heads) {
    const std::string prefix = name + "/heads/" + one.channel;
    heads_.emplace_back(*one.head, *one.branch, BranchPlace{prefix, name}, true, store, *stages_);
    axes_.push_back(one.source_width > 0 ? store.add(prefix, ChannelAxes<Real>(one.source_width, one.head->width()))
                                         : -1);
  }
}

template <class Real>
void Pass<Real>::derive(const StepContext& ctx) const {
  parts_.sampler->derive(ctx, store_->tensors(sampler_));
  parts_.position->derive(ctx, store_->tensors(position_));
  parts_.field->derive(ctx, store_->tensors(field_));
  if (head_ >= 0) parts_.head->derive(ctx, store_->tensors(head_));
  if (branched_) branched_->derive(ctx);
  for (const BranchedHead<Real>& head : heads_) head.derive(ctx);
}

template <class Real>
void Pass<Real>::derive_backward(const StepContext& ctx) const {
  parts_.position->derive_backward(ctx, store_->tensors(position_));
  parts_.field->derive_backward(ctx, store_->tensors(field_));
  if (head_ >= 0) parts_.head->derive_backward(ctx, store_->tensors(head_));
  if (branched_) branched_->derive_backward(ctx);
  for (const BranchedHead<Real>& head : heads_) head.derive_backward(ctx);
}

template <class Real>
void Pass<Real>::sample(const StepContext& ctx, const Rays<Real>& rays, const Proposal<Real>* previous,
                        Samples<Real>& out) const {
  parts_.sampler->sample(ctx, store_->tensors(sampler_), rays, previous, out);
}

template <class Real>
void Pass<Real>::locate(const StepContext& ctx, const Rays<Real>& rays, const Samples<Real>& samples,
                        View<double> x) const {
  stages_->locate(place(ctx, samples), rays, parts_.domain, x);
}

template <class Real>
void Pass<Real>::encode(const StepContext& ctx, int lane, View<const double> x, View<Real> encoded) const {
  parts_.position->forward(ctx, store_->tensors(position_, lane), x, encoded);
}

template <class Real>
DensityRule Pass<Real>::density_rule(const StepContext& ctx) const {
  DensityRule rule;
  rule.activation = rules_.rendering.density_activation;
  rule.per_m = 1 / rules_.unit_m;
  rule.bias = rules_.rendering.density_bias;
  rule.first_ray = ctx.first_ray;
  if (!ctx.training || rules_.rendering.density_noise <= 0) return rule;
  rule.deviation = rules_.rendering.density_noise;
  rule.random = ctx.random("density_noise");
  return rule;
}

template <class Real>
FeatureForm Pass<Real>::feature_form(const PassTrace<Real>& trace) const {
  if (trace.semantic_rays == 0 || (trace.with_heads && heads_want_feature())) return FeatureForm::full;
  const bool rounded = parts_.head && !branched_ && parts_.head->takes_rounded() && rules_.deferred_class_layer;
  return rounded ? parts_.field->feature_form(parts_.head->hidden_width()) : FeatureForm::full;
}

template <class Real>
PassTrace<Real> Pass<Real>::forward(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                    const Proposal<Real>* previous, std::int64_t previous_per_ray,
                                    const PassRequest& request) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t ray_count = rays.origin.rows;
  std::int64_t capacity = parts_.sampler->capacity(ray_count, previous_per_ray);
  if (request.room > 0) capacity = std::min(capacity, request.room);
  SampledTile<Real> tile;
  tile.per_ray = capacity_per_ray(previous_per_ray);
  tile.samples.t = arena.take<Real>(capacity, 1);
  tile.samples.delta = arena.take<Real>(capacity, 1);
  tile.samples.ray_of_sample = arena.take<std::int32_t>(capacity, 1);
  tile.samples.first = arena.take<std::int32_t>(ray_count + 1, 1);
  sample(ctx, rays, previous, tile.samples);
  const LiveRows<Real> live(*stages_, tile.samples);
  tile.x = arena.take<double>(tile.samples.count, 3);
  locate(ctx, rays, tile.samples, tile.x);
  return forward(ctx, lane, rays, tile, request);
}

template <class Real>
PassTrace<Real> Pass<Real>::forward(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                    const SampledTile<Real>& tile, const PassRequest& request) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t ray_count = rays.origin.rows, count = tile.samples.count;
  const LiveRows<Real> live(*stages_, tile.samples);
  PassTrace<Real> trace;
  trace.samples = tile.samples;
  trace.x = tile.x;
  trace.encoded = tile.encoded;
  trace.semantic_rays = parts_.head ? request.semantic_rays : 0;
  trace.with_heads = request.heads && !heads_.empty();
  trace.semantic_samples = stages_->host_memory ? trace.samples.first(trace.semantic_rays, 0)
                                                : std::min(count, trace.semantic_rays * tile.per_ray);
  if (parts_.direction) {
    const LiveRows<Real> all_rays(*stages_, nullptr);
    trace.direction = arena.take<Real>(ray_count, parts_.direction->traits().out_dims);
    parts_.direction->forward(ctx, store_->tensors(direction_), rays.direction, trace.direction);
    stages_->guard(place(ctx, trace.samples), Guarded::encoded_direction, trace.direction);
  }
  trace.sigma = arena.take<Real>(count, 1);
  trace.weight = arena.take<Real>(count, 1);
  trace.out.sigma = arena.take<Real>(count, 1);
  if (request.colors) trace.out.rgb = arena.take<Real>(count, 3);
  if (trace.semantic_rays > 0 && !branched_) {
    HeadTrace<Real>& semantic = trace.semantic;
    semantic.ray_hidden = arena.take<Real>(trace.semantic_rays, parts_.head->hidden_width());
    semantic.rows = arena.take<Real>(trace.semantic_rays, parts_.head->width());
    if (feature_form(trace) == FeatureForm::full)
      semantic.hidden = arena.take<Real>(trace.semantic_samples, parts_.head->hidden_width());
    if (!rules_.deferred_class_layer)
      semantic.sample_rows = arena.take<Real>(trace.semantic_samples, parts_.head->width());
  }
  if (request.colors) trace.color = arena.take<Real>(ray_count, 3);
  trace.depth = arena.take<Real>(ray_count, 1);
  trace.opacity = arena.take<Real>(ray_count, 1);
  if (stages_->host_memory && !ctx.training && rules_.rendering.early_stop > 0 && count > ray_count * kRoundSamples) {
    evaluate_in_rounds(ctx, lane, trace, request.colors);
  } else {
    evaluate(ctx, lane, trace, request.colors);
  }
  composite(ctx, lane, trace);
  if (ctx.training) return trace;
  if (branched_ && trace.semantic_rays > 0) branch_forward(ctx, lane, rays, trace);
  if (trace.with_heads) heads_forward(ctx, lane, rays, trace);
  return trace;
}

template <class Real>
void Pass<Real>::evaluate(const StepContext& ctx, int lane, PassTrace<Real>& trace, bool colors) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t count = trace.samples.count;
  const GuardPlace<Real> here = place(ctx, trace.samples);
  if (trace.encoded.empty()) {
    trace.encoded = arena.take<Real>(count, encoded_dims());
    encode(ctx, lane, trace.x, trace.encoded);
  }
  stages_->guard(here, Guarded::encoded_position, trace.encoded);
  const std::int32_t width = parts_.field->traits().feature_dims;
  const bool semantic = trace.semantic_rays > 0;
  const FeatureForm form = feature_form(trace);
  if (form == FeatureForm::hidden_layer) {
    trace.out.fused.layer = parts_.head->hidden_layer(head_tensors(lane));
    trace.out.fused.hidden = arena.take<Bf16>(trace.semantic_samples, parts_.head->hidden_width());
    trace.rounded_hidden = trace.out.fused.hidden;
  } else if (form == FeatureForm::rounded) {
    trace.out.fused.feature = arena.take<Bf16>(count, width);
  } else if (wants_feature(trace)) {
    trace.out.feature = arena.take<Real>(count, width);
  }
  if (ctx.training) {
    const std::size_t bytes = parts_.field->saved_bytes(count, trace.samples.first.rows - 1);
    trace.saved = Saved(arena.take_bytes(bytes), bytes);
  }
  const View<const std::int32_t> ray_of_sample = trace.samples.ray_of_sample.row_range(0, count);
  parts_.field->forward(ctx, store_->tensors(field_, lane), {trace.encoded, trace.direction, ray_of_sample}, trace.out,
                        trace.saved);
  stages_->guard(here, Guarded::raw_density, trace.out.sigma);
  if (colors) stages_->guard(here, Guarded::sample_color, trace.out.rgb);
  if (!trace.out.feature.empty()) {
    const bool of_all = trace.with_heads && heads_want_feature();
    stages_->guard(here, Guarded::feature, trace.out.feature.row_range(0, of_all ? count : trace.semantic_samples));
  }
  stages_->density_forward(density_rule(ctx), &trace.samples, trace.out.sigma, trace.sigma);
  if (!semantic || branched_) return;
  if (form == FeatureForm::rounded) {
    trace.rounded_hidden = arena.take<Bf16>(trace.semantic_samples, parts_.head->hidden_width());
    parts_.head->rounded_hidden_forward(
        ctx, head_tensors(lane), trace.out.fused.feature.row_range(0, trace.semantic_samples), trace.rounded_hidden);
  } else if (form == FeatureForm::full) {
    parts_.head->hidden_forward(ctx, head_tensors(lane), trace.out.feature.row_range(0, trace.semantic_samples),
                                trace.semantic.hidden);
  }
}

template <class Real>
CompositeIn<Real> Pass<Real>::composite_in(const PassTrace<Real>& trace) const {
  CompositeIn<Real> in;
  in.samples = &trace.samples;
  in.sigma = trace.sigma;
  in.rgb = trace.out.rgb;
  in.far = rules_.rendering.far;
  in.background = rules_.background();
  return in;
}

template <class Real>
void Pass<Real>::composite(const StepContext& ctx, int lane, PassTrace<Real>& trace) const {
  const GuardPlace<Real> here = place(ctx, trace.samples);
  if (stages_->guard_density != nullptr) stages_->guard_density(here, trace.sigma);
  CompositeIn<Real> in = composite_in(trace);
  CompositeOut<Real> out;
  out.color = trace.color;
  out.depth = trace.depth;
  out.opacity = trace.opacity;
  out.weight = trace.weight;
  const bool semantic = trace.semantic_rays > 0 && !branched_;  // a branch follows the weights
  const bool deferred = rules_.deferred_class_layer, rounded = !trace.rounded_hidden.empty();
  if (semantic && !rounded) {
    if (!deferred)
      parts_.head->output_forward(ctx, head_tensors(lane), trace.semantic.hidden, {}, trace.semantic.sample_rows);
    in.hidden = deferred ? trace.semantic.hidden : trace.semantic.sample_rows;
    out.hidden = deferred ? trace.semantic.ray_hidden : trace.semantic.rows;
  }
  stages_->composite_forward(in, out);
  if (semantic && rounded)
    stages_->rounded_sum(trace.samples, trace.weight, trace.rounded_hidden, trace.semantic.ray_hidden);
  if (semantic && deferred) {
    parts_.head->output_forward(ctx, head_tensors(lane), trace.semantic.ray_hidden,
                                trace.opacity.row_range(0, trace.semantic_rays), trace.semantic.rows);
  }
  stages_->guard(here, Guarded::color, trace.color);
  stages_->guard(here, Guarded::depth, trace.depth);
  stages_->guard(here, Guarded::opacity, trace.opacity);
  if (semantic) stages_->guard(here, Guarded::logits, trace.semantic.rows);
}

template <class Real>
void Pass<Real>::backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace, const RayGradients<Real>& d,
                          View<const Real> d_logits, View<Real> d_encoded) const {
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const std::int64_t count = trace.samples.count;
  if (count == 0) return;
  const LiveRows<Real> live(*stages_, trace.samples);
  const bool semantic = trace.semantic_rays > 0 && !d_logits.empty();
  SEMFIELD_CHECK(!semantic || !branched_, "gradients of a branch are branch_backward's");
  const bool deferred = rules_.deferred_class_layer, rounded = !trace.rounded_hidden.empty();
  const bool moves_density = !rules_.semantics.stop_gradient_to_density;
  const View<Real> d_sigma = arena.take<Real>(count, 1), d_rgb = arena.take<Real>(count, 3);
  CompositeIn<Real> in = composite_in(trace);
  CompositeOut<Real> out;
  out.weight = trace.weight;
  CompositeGrad<Real> grad;
  grad.color = d.color;
  grad.depth = d.depth;
  grad.weight = d.weight;
  FieldGrad<Real> of_field;
  View<Real> d_per_sample;
  if (semantic) {
    grad.hidden = d_logits;
    if (deferred) {
      const View<Real> d_ray_hidden = arena.take<Real>(trace.semantic_rays, parts_.head->hidden_width());
      const View<Real> d_opacity = arena.take<Real>(trace.semantic_rays, 1);
      parts_.head->output_backward(ctx, head_tensors(lane), trace.semantic.ray_hidden,
                                   trace.opacity.row_range(0, trace.semantic_rays), d_logits, d_ray_hidden, d_opacity);
      grad.hidden = d_ray_hidden;
      if (moves_density) grad.opacity = d_opacity;
    }
    grad.hidden_moves_density = moves_density;
    if (rounded) {
      View<Real> dots;
      if (moves_density) dots = stages_->host_memory ? arena.take<Real>(trace.semantic_samples, 1) : d_sigma;
      rounded_backward(ctx, lane, trace, grad.hidden, dots, of_field);
      grad.dotted_rays = moves_density ? trace.semantic_rays : 0;
      grad.dots = dots;
      grad.hidden = {};
    } else {
      in.hidden = deferred ? trace.semantic.hidden : trace.semantic.sample_rows;
      d_per_sample = arena.take<Real>(trace.semantic_samples, in.hidden.cols);
    }
  }
  stages_->composite_backward(in, out, grad, d_sigma, d_rgb, d_per_sample);
  if (semantic && !rounded) hidden_backward(ctx, lane, trace, d_per_sample, of_field);
  if (!d.sigma.empty()) stages_->add(d.sigma, d_sigma);
  stages_->density_backward(density_rule(ctx), trace.out.sigma, d_sigma, d_sigma);
  of_field.sigma = d_sigma;
  of_field.rgb = d_rgb;
  const View<const std::int32_t> ray_of_sample = trace.samples.ray_of_sample.row_range(0, count);
  parts_.field->backward(ctx, store_->tensors(field_, lane), {trace.encoded, trace.direction, ray_of_sample}, trace.out,
                         of_field, trace.saved, d_encoded);
}

// d_per_sample: dL/d(hidden), or dL/d(logits of the samples) with the deferral switched off.
template <class Real>
void Pass<Real>::hidden_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace,
                                 View<Real> d_per_sample, FieldGrad<Real>& grad) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t count = trace.samples.count, rows = trace.semantic_samples;
  View<Real> d_hidden = d_per_sample;
  if (!rules_.deferred_class_layer) {
    d_hidden = arena.take<Real>(rows, parts_.head->hidden_width());
    parts_.head->output_backward(ctx, head_tensors(lane), trace.semantic.hidden, {}, d_per_sample, d_hidden, {});
  }
  const View<Real> d_feature = arena.take<Real>(count, parts_.field->traits().feature_dims);
  stages_->fill(d_feature.row_range(rows, count - rows), Real(0));
  parts_.head->hidden_backward(ctx, head_tensors(lane), trace.out.feature.row_range(0, rows), trace.semantic.hidden,
                               d_hidden, d_feature.row_range(0, rows));
  grad.feature = d_feature;
}

// Where field and head exchange bf16: a quarter of the bytes between them.
template <class Real>
void Pass<Real>::rounded_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace,
                                  View<const Real> d_ray_hidden, View<Real> dots, FieldGrad<Real>& grad) const {
  Workspace& arena = *ctx.workspace;
  const bool by_field = !trace.out.fused.hidden.empty();  // the hidden layer
  const std::int64_t rows = trace.semantic_samples;
  RoundedSumBackward<Real> sum;
  sum.weight = trace.weight;
  sum.hidden = trace.rounded_hidden;
  sum.d_out = d_ray_hidden;
  sum.dots = dots;
  sum.d_hidden = arena.take<Bf16>(by_field ? blocked_rows(rows) : rows, parts_.head->hidden_width());
  sum.blocked = by_field;
  stages_->rounded_sum_backward(trace.samples, sum);
  if (by_field) {
    grad.fused.hidden = sum.d_hidden.data;
    return;
  }
  const View<Bf16> d_feature = arena.take<Bf16>(rows, trace.out.fused.feature.cols);
  parts_.head->rounded_hidden_backward(ctx, head_tensors(lane), trace.out.fused.feature.row_range(0, rows),
                                       sum.d_hidden, d_feature);
  grad.fused.feature = d_feature;
}

template <class Real>
void Pass<Real>::ray_gradient(const StepContext& ctx, const Rays<Real>& rays, const PassTrace<Real>& trace,
                              View<const Real> d_encoded, View<Real> d_ray) const {
  if (trace.samples.count == 0) return;
  const Workspace::Scope scope(*ctx.workspace);
  const LiveRows<Real> live(*stages_, trace.samples);
  const View<Real> dx = ctx.workspace->take<Real>(trace.samples.count, 3);
  const Tensors<Real> values{store_->tensors(position_).value, {}};
  parts_.position->backward(ctx, values, trace.x, d_encoded, dx);
  stages_->locate_backward(rays, trace.samples, parts_.domain, dx, d_ray);
}

template <class Real>
void Pass<Real>::scatter(const StepContext& ctx, View<const double> x, View<const Real> dy) const {
  if (x.rows == 0) return;
  parts_.position->backward(ctx, store_->tensors(position_), x, dy, {});
}

template class Pass<float>;
template class Pass<double>;

}  // namespace semfield
