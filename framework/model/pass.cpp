#include "model/pass.h"

#include <cmath>
#include <cstring>
#include <numeric>

#include "core/check.h"
#include "core/error.h"

namespace semfield {

template <class Real>
Pass<Real>::Pass(PassParts<Real> parts, const RenderRules& rules, TensorStore<Real>& store)
    : parts_(std::move(parts)), rules_(rules), store_(&store), stages_(parts_.stages) {
  const std::string& name = parts_.name;
  encoder_learns_ = learns<Real>(*parts_.position);
  if (parts_.direction && learns<Real>(*parts_.direction)) {
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
  std::int64_t capacity = parts_.sampler->capacity(ray_count, previous_per_ray, ctx.training);
  if (request.room > 0) capacity = std::min(capacity, request.room);
  SampledTile<Real> tile;
  tile.per_ray = capacity_per_ray(previous_per_ray, ctx.training);
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
  PassTrace<Real> trace = forward_all(ctx, lane, rays, reached(ctx, lane, rays, tile, request.reached_room), request);
  trace.drawn = tile.samples;
  return trace;
}

// Densities come in rounds: a ray is asked for as many further samples as it has had, so that at most twice as many are
// asked for as light reaches.
template <class Real>
SampledTile<Real> Pass<Real>::reached(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                      const SampledTile<Real>& tile, std::int64_t room) const {
  constexpr std::int64_t kFirstRound = 16;
  if (!ctx.training || rules_.rendering.training_stop <= 0 || tile.reached) return tile;
  Workspace& arena = *ctx.workspace;
  const std::int64_t count = tile.samples.count, most = room > 0 ? std::min(room, count) : count;
  const View<Real> sigma = arena.take<Real>(count, 1);
  stages_->fill(sigma, Real(0));
  DensityRule rule = density_rule(ctx);
  rule.deviation = 0;
  const auto located = [&](const Samples<Real>& samples) {
    const View<double> x = arena.take<double>(samples.count, 3);
    locate(ctx, rays, samples, x);
    return x;
  };
  ReachedBy part{0, kFirstRound, rules_.rendering.training_stop};
  for (; part.begin < tile.per_ray; part.begin = part.end, part.end *= 2) {
    const Workspace::Scope scope(arena);
    const std::int64_t of_round = part.begin == 0 ? std::min(count, kFirstRound * rays.origin.rows) : most;
    const ChosenSamples<Real> chosen = stages_->reached(arena, tile.samples, sigma, part, of_round);
    const LiveRows<Real> live(*stages_, chosen.samples);
    const View<Real> encoded = arena.take<Real>(chosen.samples.count, encoded_dims());
    encode(ctx, lane, located(chosen.samples), encoded);
    const View<Real> raw = arena.take<Real>(chosen.samples.count, 1);
    parts_.field->forward(ctx, store_->tensors(field_, lane), {.position = encoded}, {.sigma = raw}, {});
    stages_->density_forward(rule, &chosen.samples, raw, raw);
    stages_->spread(chosen, raw, sigma);
  }
  SampledTile<Real> out;
  out.samples = stages_->reached(arena, tile.samples, sigma, {0, tile.per_ray, part.least}, most).samples;
  out.per_ray = tile.per_ray;
  out.reached = true;
  const LiveRows<Real> live(*stages_, out.samples);
  out.x = located(out.samples);
  return out;
}

template <class Real>
PassTrace<Real> Pass<Real>::forward_all(const StepContext& ctx, int lane, const Rays<Real>& rays,
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
void Pass<Real>::composite(const StepContext& ctx, int lane, PassTrace<Real>& trace) const {
  const GuardPlace<Real> here = place(ctx, trace.samples);
  if (stages_->guard_density != nullptr) stages_->guard_density(here, trace.sigma);
  CompositeIn<Real> in = composite_in(trace);
  CompositeOut<Real> out{.color = trace.color, .depth = trace.depth, .opacity = trace.opacity, .weight = trace.weight};
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
  const CompositeOut<Real> out{.weight = trace.weight};
  CompositeGrad<Real> grad{.color = d.color, .depth = d.depth, .weight = d.weight};
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
  const RoundedSumBackward<Real> sum{
      .weight = trace.weight,
      .hidden = trace.rounded_hidden,
      .d_out = d_ray_hidden,
      .dots = dots,
      .d_hidden = arena.take<Bf16>(by_field ? blocked_rows(rows) : rows, parts_.head->hidden_width()),
      .blocked = by_field};
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

// What stands behind branches of its own: class logits where they do, and the channels of the other heads.

template <class Real>
RayValues<Real> Pass<Real>::values_of(View<const double> near_far, const PassTrace<Real>& trace) const {
  RayValues<Real> values;
  values.unit_m = rules_.unit_m;
  values.near_far = near_far;
  values.first = trace.samples.first;
  values.t = trace.samples.t;
  values.delta = trace.samples.delta;
  values.sigma = trace.sigma;
  values.weight = trace.weight;
  values.color = trace.color;
  values.depth = trace.depth;
  values.opacity = trace.opacity;
  if (!trace.semantic.rows.empty()) values.heads.set(channel::logits, trace.semantic.rows);
  for (std::size_t i = 0; i < heads_.size(); ++i)
    if (!trace.heads[i].rows.empty()) values.heads.set(parts_.heads[i].channel, trace.heads[i].rows);
  return values;
}

// What is asked for by position and not along rays: density, of which samplers and meshes are made, and semantics,
// where a point is a sample of weight 1.

template <class Real>
View<Real> Pass<Real>::encoded_at(const StepContext& ctx, View<const double> positions) const {
  const View<double> x = ctx.workspace->take<double>(positions.rows, 3);
  stages_->map_positions(positions, parts_.domain, x);
  const View<Real> encoded = ctx.workspace->take<Real>(positions.rows, encoded_dims());
  parts_.position->forward(ctx, store_->tensors(position_), x, encoded);
  return encoded;
}

template <class Real>
void Pass<Real>::density(const StepContext& ctx, View<const double> positions, View<Real> sigma) const {
  Workspace& arena = *ctx.workspace;
  const LiveRows<Real> all(*stages_, nullptr);
  DensityRule rule = density_rule(ctx);
  rule.deviation = 0;
  for (std::int64_t begin = 0; begin < positions.rows; begin += stages_->density_batch) {
    const std::int64_t count = std::min(stages_->density_batch, positions.rows - begin);
    const Workspace::Scope scope(arena);
    const View<const double> places = positions.row_range(begin, count);
    const View<Real> encoded = encoded_at(ctx, places), raw = arena.take<Real>(count, 1);
    parts_.field->forward(ctx, store_->tensors(field_), {.position = encoded}, {.sigma = raw}, {});
    const View<Real> found = sigma.row_range(begin, count);
    stages_->density_forward(rule, nullptr, raw, found);
    if (stages_->guard_density_at != nullptr) stages_->guard_density_at(places, raw, found);
  }
}

template <class Real>
void Pass<Real>::point_colors(const StepContext& ctx, View<const double> positions, View<const double> directions,
                              View<Real> color) const {
  SEMFIELD_CHECK(stages_->host_memory, "colours of points are the CPU's");
  if (positions.rows == 0) return;
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  FieldIn<Real> in{.position = encoded_at(ctx, positions)};
  if (parts_.direction) {
    const View<Real> seen = arena.take<Real>(positions.rows, parts_.direction->traits().out_dims);
    parts_.direction->forward(ctx, store_->tensors(direction_), directions, seen);
    in.direction = seen;
    const View<std::int32_t> own = arena.take<std::int32_t>(positions.rows, 1);
    std::iota(own.data, own.data + own.rows, 0);
    in.ray_of_sample = own;
  }
  parts_.field->forward(ctx, store_->tensors(field_), in, {.sigma = arena.take<Real>(positions.rows, 1), .rgb = color},
                        {});
}

template <class Real>
void Pass<Real>::point_rows(const StepContext& ctx, View<const double> positions, View<Real> rows) const {
  SEMFIELD_CHECK(parts_.head, "points of a pass with semantics");
  if (positions.rows == 0) return;
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const LiveRows<Real> all(*stages_, nullptr);
  std::int32_t of_position = 0;
  if (branched_) {
    of_position = branched_->input_dims(0);
    branched_->encode_points(ctx, positions, rows);
    if (!branched_->rules().reads_feature) return;
  }
  parts_.field->forward(ctx, store_->tensors(field_), {.position = encoded_at(ctx, positions)},
                        {.feature = rows.col_range(of_position, parts_.field->traits().feature_dims)}, {});
}

template <class Real>
PointTrace<Real> Pass<Real>::point_forward(const StepContext& ctx, int lane, View<const Real> rows,
                                           View<Real> logits) const {
  PointTrace<Real> trace;
  if (branched_) {
    trace.branch = branched_->forward_points(ctx, lane, rows);
    trace.feature = trace.branch.feature;
  } else {
    trace.feature = rows;
  }
  const Tensors<Real> head = head_tensors(lane);
  trace.hidden = ctx.workspace->take<Real>(rows.rows, parts_.head->hidden_width());
  parts_.head->hidden_forward(ctx, head, trace.feature, trace.hidden);
  parts_.head->output_forward(ctx, head, trace.hidden, {}, logits);
  return trace;
}

template <class Real>
void Pass<Real>::point_backward(const StepContext& ctx, int lane, const PointTrace<Real>& trace,
                                View<const Real> d_logits) const {
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const Tensors<Real> head = head_tensors(lane);
  const View<Real> d_hidden = arena.take<Real>(d_logits.rows, trace.hidden.cols);
  const View<Real> d_feature = arena.take<Real>(d_logits.rows, trace.feature.cols);
  parts_.head->output_backward(ctx, head, trace.hidden, {}, d_logits, d_hidden, {});
  parts_.head->hidden_backward(ctx, head, trace.feature, trace.hidden, d_hidden, d_feature);
  if (branched_) branched_->branch_backward(ctx, lane, trace.branch, d_feature);
}

// Rendering that ends a ray where nothing behind can be seen.

// Front to back in rounds of kRoundSamples samples per ray. A ray whose transmittance fell below early_stop asks no
// further. Samples that were not evaluated keep sigma = 0, so they take no weight: |error| <= early_stop * max|value|
// (numerics: certified). Under far: background the last sample takes the rest, black and with the logits of no feature,
// which count as values too.
template <class Real>
void Pass<Real>::evaluate_in_rounds(const StepContext& ctx, int lane, PassTrace<Real>& trace, bool colors) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t ray_count = trace.samples.first.rows - 1;
  View<std::int32_t> next = arena.take<std::int32_t>(ray_count, 1);
  View<Real> tau = arena.take<Real>(ray_count, 1);
  for (std::int64_t r = 0; r < ray_count; ++r) next(r, 0) = trace.samples.first(r, 0);
  stages_->fill(tau, Real(0));
  stages_->fill(trace.sigma, Real(0));
  if (colors) stages_->fill(trace.out.rgb, Real(0));
  const bool semantic = trace.semantic_rays > 0;
  const bool fills_hidden = semantic && !branched_;
  const bool fills_feature = (semantic && branched_ && wants_feature()) || (trace.with_heads && heads_want_feature());
  const bool in_bf16 = fills_hidden && feature_form(trace) != FeatureForm::full;
  if (in_bf16) {
    trace.rounded_hidden = arena.take<Bf16>(trace.semantic_samples, parts_.head->hidden_width());
    std::fill_n(trace.rounded_hidden.data, trace.rounded_hidden.size(), Bf16{0});
  } else if (fills_hidden) {
    stages_->fill(trace.semantic.hidden, Real(0));
  }
  if (fills_feature) {
    trace.out.feature = arena.take<Real>(trace.samples.count, parts_.field->traits().feature_dims);
    stages_->fill(trace.out.feature, Real(0));
  }
  const double tau_stop = -std::log(rules_.rendering.early_stop);
  View<std::int32_t> source = arena.take<std::int32_t>(ray_count * kRoundSamples, 1);
  for (;;) {
    const Workspace::Scope scope(arena);
    PassTrace<Real> round;
    round.samples.ray_of_sample = arena.take<std::int32_t>(ray_count * kRoundSamples, 1);
    round.samples.first = trace.samples.first;  // only its row count is read
    std::int64_t rows = 0, semantic_rows = 0;
    for (std::int64_t r = 0; r < ray_count; ++r) {
      const std::int32_t end = trace.samples.first(r + 1, 0);
      if (static_cast<double>(tau(r, 0)) > tau_stop) next(r, 0) = end;
      const std::int32_t stop = std::min<std::int32_t>(end, next(r, 0) + static_cast<std::int32_t>(kRoundSamples));
      for (std::int32_t m = next(r, 0); m < stop; ++m, ++rows) {
        source(rows, 0) = m;
        round.samples.ray_of_sample(rows, 0) = static_cast<std::int32_t>(r);
      }
      if (r < trace.semantic_rays) semantic_rows = rows;
    }
    if (rows == 0) break;
    round.samples.count = rows;
    round.semantic_rays = trace.semantic_rays;
    round.with_heads = trace.with_heads;
    round.semantic_samples = semantic_rows;
    round.x = arena.take<double>(rows, 3);
    round.direction = trace.direction;
    round.sigma = arena.take<Real>(rows, 1);
    round.out.sigma = arena.take<Real>(rows, 1);
    if (colors) round.out.rgb = arena.take<Real>(rows, 3);
    if (fills_hidden && !in_bf16) round.semantic.hidden = arena.take<Real>(semantic_rows, parts_.head->hidden_width());
    for (std::int64_t i = 0; i < rows; ++i) std::memcpy(round.x.row(i), trace.x.row(source(i, 0)), 3 * sizeof(double));
    evaluate(ctx, lane, round, colors);
    for (std::int64_t i = 0; i < rows; ++i) {
      const std::int64_t m = source(i, 0);
      const std::int64_t r = round.samples.ray_of_sample(i, 0);
      trace.sigma(m, 0) = round.sigma(i, 0);
      tau(r, 0) += round.sigma(i, 0) * trace.samples.delta(m, 0);
      if (colors) std::copy_n(round.out.rgb.row(i), 3, trace.out.rgb.row(m));
      if (in_bf16 && i < semantic_rows) {
        std::copy_n(round.rounded_hidden.row(i), round.rounded_hidden.cols, trace.rounded_hidden.row(m));
      } else if (fills_hidden && i < semantic_rows) {
        std::copy_n(round.semantic.hidden.row(i), round.semantic.hidden.cols, trace.semantic.hidden.row(m));
      }
      if (fills_feature) std::copy_n(round.out.feature.row(i), trace.out.feature.cols, trace.out.feature.row(m));
      next(r, 0) = static_cast<std::int32_t>(m + 1);
    }
  }
}

template class Pass<float>;
template class Pass<double>;

}  // namespace semfield
