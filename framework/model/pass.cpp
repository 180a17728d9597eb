#include "model/pass.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/error.h"
#include "core/parallel.h"
#include "model/ray_guard.h"

namespace semfield {

namespace {
constexpr std::int64_t kRound = 16;  // samples a ray advances before early stop is tested

template <class T>
void fill_zero(View<T> view) {
  for (std::int64_t r = 0; r < view.rows; ++r) std::fill_n(view.row(r), view.cols, T(0));
}

// Rays [begin, begin + count) of the samples: `first` keeps its absolute offsets, so the sample arrays stay whole.
template <class Real>
Samples<Real> rays_of(const Samples<Real>& samples, std::int64_t begin, std::int64_t count) {
  Samples<Real> part = samples;
  part.first = samples.first.row_range(begin, count + 1);
  return part;
}
// Rays [begin, begin + count) of a trace as the compositor reads and writes them.
template <class Real>
struct RayGroup {
  RayGroup(const PassTrace<Real>& trace, const RenderRules& rules, std::int64_t begin, std::int64_t count,
           bool with_semantics)
      : samples(rays_of(trace.samples, begin, count)) {
    in.samples = &samples;
    in.sigma = trace.sigma;
    in.rgb = trace.out.rgb;
    in.far = rules.far;
    in.background = rules.background;
    out.color = trace.color.row_range(begin, count);
    out.depth = trace.depth.row_range(begin, count);
    out.opacity = trace.opacity.row_range(begin, count);
    out.weight = trace.weight;
    if (!with_semantics) return;
    in.hidden = rules.deferred_class_layer ? trace.hidden : trace.sample_logits;
    out.hidden = rules.deferred_class_layer ? trace.ray_hidden : trace.logits;
  }
  RayGroup(const RayGroup&) = delete;
  RayGroup& operator=(const RayGroup&) = delete;

  Samples<Real> samples;
  CompositeIn<Real> in;
  CompositeOut<Real> out;
};
}  // namespace

template <class Real>
Pass<Real>::Pass(PassParts<Real> parts, const RenderRules& rules, ParamStore<Real>& store)
    : parts_(std::move(parts)), rules_(rules), store_(&store) {
  const std::string& name = parts_.name;
  sampler_ = store.add(name + "/sampler", *parts_.sampler);
  const std::size_t before = store.all().size();
  position_ = store.add(name + "/position", *parts_.position);
  for (std::size_t i = before; i < store.all().size(); ++i)
    encoder_learns_ = encoder_learns_ || store.all()[i].learned();
  if (parts_.direction) {
    const std::size_t first = store.all().size();
    direction_ = store.add(name + "/direction", *parts_.direction);
    for (std::size_t i = first; i < store.all().size(); ++i) {
      if (store.all()[i].learned()) {
        throw Error(
            ErrorKind::config,
            "pass '" + name +
                "': the direction encoder has learned tensors; directions are encoded once a ray without gradients",
            "choose a direction encoder without learned tensors");
      }
    }
  }
  field_ = store.add(name + "/field", *parts_.field);
  const LearningRule rule = parts_.branch ? parts_.branch->rules.learning() : LearningRule{};
  if (parts_.head) head_ = store.add(name + "/semantic", *parts_.head, rule);
  if (parts_.head && parts_.branch) branch_.emplace(*parts_.branch, name, store);
}

template <class Real>
void Pass<Real>::derive(const StepContext& ctx) const {
  parts_.sampler->derive(ctx, store_->tensors(sampler_));
  parts_.position->derive(ctx, store_->tensors(position_));
  parts_.field->derive(ctx, store_->tensors(field_));
  if (parts_.head) parts_.head->derive(ctx, store_->tensors(head_));
  if (branch_) branch_->derive(ctx);
}

template <class Real>
void Pass<Real>::derive_backward(const StepContext& ctx) const {
  parts_.position->derive_backward(ctx, store_->tensors(position_));
  parts_.field->derive_backward(ctx, store_->tensors(field_));
  if (parts_.head) parts_.head->derive_backward(ctx, store_->tensors(head_));
  if (branch_) branch_->derive_backward(ctx);
}

template <class Real>
void Pass<Real>::sample(const StepContext& ctx, const Rays<Real>& rays, const Proposal<Real>* previous,
                        Samples<Real>& out) const {
  parts_.sampler->sample(ctx, store_->tensors(sampler_), rays, previous, out);
}

template <class Real>
void Pass<Real>::locate(const StepContext& ctx, const Rays<Real>& rays, const Samples<Real>& samples,
                        View<double> x) const {
  const DomainMap& map = parts_.domain;
  for (std::int64_t m = 0; m < samples.count; ++m) {
    const std::int64_t r = samples.ray_of_sample(m, 0);
    const double t = static_cast<double>(samples.t(m, 0));
    Vec3d p;
    for (int i = 0; i < 3; ++i) p[i] = rays.origin(r, i) + t * rays.direction(r, i);
    const Vec3d at = map(p);
    for (int i = 0; i < 3; ++i) x(m, i) = at[i];
  }
  RayGuard<Real>(parts_.name, ctx.first_ray, samples).samples(x);
}

template <class Real>
void Pass<Real>::encode(const StepContext& ctx, int lane, View<const double> x, View<Real> encoded) const {
  parts_.position->forward(ctx, store_->tensors(position_, lane), x, encoded);
}

template <class Real>
PassTrace<Real> Pass<Real>::forward(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                    const Proposal<Real>* previous, std::int64_t previous_per_ray,
                                    std::int64_t semantic_rays) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t ray_count = rays.origin.rows;
  const std::int64_t capacity = parts_.sampler->capacity(ray_count, previous_per_ray);
  SampledTile<Real> tile;
  tile.samples.t = arena.take<Real>(capacity, 1);
  tile.samples.delta = arena.take<Real>(capacity, 1);
  tile.samples.ray_of_sample = arena.take<std::int32_t>(capacity, 1);
  tile.samples.first = arena.take<std::int32_t>(ray_count + 1, 1);
  sample(ctx, rays, previous, tile.samples);
  tile.x = arena.take<double>(tile.samples.count, 3);
  locate(ctx, rays, tile.samples, tile.x);
  return forward(ctx, lane, rays, tile, semantic_rays);
}

template <class Real>
PassTrace<Real> Pass<Real>::forward(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                    const SampledTile<Real>& tile, std::int64_t semantic_rays) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t ray_count = rays.origin.rows;
  PassTrace<Real> trace;
  trace.samples = tile.samples;
  trace.x = tile.x;
  trace.encoded = tile.encoded;
  const std::int64_t count = trace.samples.count;
  trace.semantic_rays = parts_.head ? semantic_rays : 0;
  trace.semantic_samples = trace.samples.first(trace.semantic_rays, 0);
  if (parts_.direction) {
    trace.direction = arena.take<Real>(ray_count, parts_.direction->traits().out_dims);
    parts_.direction->forward(ctx, store_->tensors(direction_), rays.direction, trace.direction);
    RayGuard<Real>(parts_.name, ctx.first_ray, trace.samples).per_ray("encoded direction", trace.direction);
  }
  trace.sigma = arena.take<Real>(count, 1);
  trace.weight = arena.take<Real>(count, 1);
  trace.out.sigma = arena.take<Real>(count, 1);
  trace.out.rgb = arena.take<Real>(count, 3);
  if (parts_.head) {
    trace.ray_hidden = arena.take<Real>(trace.semantic_rays, parts_.head->hidden_width());
    trace.logits = arena.take<Real>(trace.semantic_rays, parts_.head->classes());
  }
  if (parts_.head && !branch_) {
    trace.hidden = arena.take<Real>(trace.semantic_samples, parts_.head->hidden_width());
    if (!rules_.deferred_class_layer)
      trace.sample_logits = arena.take<Real>(trace.semantic_samples, parts_.head->classes());
  }
  trace.color = arena.take<Real>(ray_count, 3);
  trace.depth = arena.take<Real>(ray_count, 1);
  trace.opacity = arena.take<Real>(ray_count, 1);
  if (!ctx.training && rules_.early_stop > 0 && count > ray_count * kRound) {
    evaluate_in_rounds(ctx, lane, trace);
  } else {
    evaluate(ctx, lane, trace, ctx.training);
  }
  composite(ctx, lane, trace);
  if (branch_ && trace.semantic_rays > 0) branch_forward(ctx, lane, rays, trace);
  const RayGuard<Real> guard(parts_.name, ctx.first_ray, trace.samples);
  guard.per_ray("logits", trace.logits);
  return trace;
}

template <class Real>
void Pass<Real>::evaluate(const StepContext& ctx, int lane, PassTrace<Real>& trace, bool training) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t count = trace.samples.count;
  if (trace.encoded.empty()) {
    trace.encoded = arena.take<Real>(count, encoded_dims());
    encode(ctx, lane, trace.x, trace.encoded);
  }
  const RayGuard<Real> guard(parts_.name, ctx.first_ray, trace.samples);
  guard.per_sample("encoded position", trace.encoded);
  if (wants_feature()) trace.out.feature = arena.take<Real>(count, parts_.field->traits().feature_dims);
  if (training) {
    const std::size_t bytes = parts_.field->saved_bytes(count, trace.samples.first.rows - 1);
    trace.saved = Saved(arena.take_bytes(bytes), bytes);
  }
  const View<const std::int32_t> ray_of_sample = trace.samples.ray_of_sample.row_range(0, count);
  parts_.field->forward(ctx, store_->tensors(field_, lane), {trace.encoded, trace.direction, ray_of_sample}, trace.out,
                        trace.saved);
  guard.per_sample("raw density", trace.out.sigma);
  guard.per_sample("colour", trace.out.rgb);
  if (wants_feature()) guard.per_sample("feature", trace.out.feature.row_range(0, trace.semantic_samples));
  if (rules_.density_bias != 0) {
    for (std::int64_t m = 0; m < count; ++m) trace.out.sigma(m, 0) += static_cast<Real>(rules_.density_bias);
  }
  if (training && rules_.density_noise > 0) {
    add_density_noise<Real>(ctx.random("density_noise"), ctx.first_ray, trace.samples.first, rules_.density_noise,
                            trace.out.sigma);
  }
  density_forward<Real>(rules_.activation, trace.out.sigma, trace.sigma);
  if (parts_.head && !branch_ && trace.semantic_samples > 0) {
    parts_.head->hidden_forward(ctx, store_->tensors(head_, lane),
                                trace.out.feature.row_range(0, trace.semantic_samples), trace.hidden);
  }
}

// Front to back in rounds of kRound samples a ray; a ray whose transmittance fell below early_stop asks no further.
// Samples that were not evaluated keep sigma = 0, so they take no weight: |error| <= early_stop * max|value| (numerics:
// certified). Under far: background the last sample takes the rest, black and with the logits of no feature, which
// count as values too.
template <class Real>
void Pass<Real>::evaluate_in_rounds(const StepContext& ctx, int lane, PassTrace<Real>& trace) const {
  Workspace& arena = *ctx.workspace;
  const std::int64_t ray_count = trace.samples.first.rows - 1;
  View<std::int32_t> next = arena.take<std::int32_t>(ray_count, 1);
  View<Real> tau = arena.take<Real>(ray_count, 1);
  for (std::int64_t r = 0; r < ray_count; ++r) next(r, 0) = trace.samples.first(r, 0);
  fill_zero(tau);
  fill_zero(trace.sigma);
  fill_zero(trace.out.rgb);
  const bool fills_hidden = parts_.head && !branch_, fills_feature = branch_ && wants_feature();
  if (fills_hidden) fill_zero(trace.hidden);
  if (fills_feature) {
    trace.out.feature = arena.take<Real>(trace.samples.count, parts_.field->traits().feature_dims);
    fill_zero(trace.out.feature);
  }
  const double tau_stop = -std::log(rules_.early_stop);
  View<std::int32_t> source = arena.take<std::int32_t>(ray_count * kRound, 1);
  for (;;) {
    const Workspace::Scope scope(arena);
    PassTrace<Real> round;
    round.samples.ray_of_sample = arena.take<std::int32_t>(ray_count * kRound, 1);
    round.samples.first = trace.samples.first;  // only its row count is read
    std::int64_t rows = 0, semantic_rows = 0;
    for (std::int64_t r = 0; r < ray_count; ++r) {
      const std::int32_t end = trace.samples.first(r + 1, 0);
      if (static_cast<double>(tau(r, 0)) > tau_stop) next(r, 0) = end;
      const std::int32_t stop = std::min<std::int32_t>(end, next(r, 0) + static_cast<std::int32_t>(kRound));
      for (std::int32_t m = next(r, 0); m < stop; ++m, ++rows) {
        source(rows, 0) = m;
        round.samples.ray_of_sample(rows, 0) = static_cast<std::int32_t>(r);
      }
      if (r < trace.semantic_rays) semantic_rows = rows;
    }
    if (rows == 0) break;
    round.samples.count = rows;
    round.semantic_samples = semantic_rows;
    round.x = arena.take<double>(rows, 3);
    round.direction = trace.direction;
    round.sigma = arena.take<Real>(rows, 1);
    round.out.sigma = arena.take<Real>(rows, 1);
    round.out.rgb = arena.take<Real>(rows, 3);
    if (fills_hidden) round.hidden = arena.take<Real>(semantic_rows, parts_.head->hidden_width());
    for (std::int64_t i = 0; i < rows; ++i) std::memcpy(round.x.row(i), trace.x.row(source(i, 0)), 3 * sizeof(double));
    evaluate(ctx, lane, round, false);
    for (std::int64_t i = 0; i < rows; ++i) {
      const std::int64_t m = source(i, 0);
      const std::int64_t r = round.samples.ray_of_sample(i, 0);
      trace.sigma(m, 0) = round.sigma(i, 0);
      tau(r, 0) += round.sigma(i, 0) * trace.samples.delta(m, 0);
      std::copy_n(round.out.rgb.row(i), 3, trace.out.rgb.row(m));
      if (fills_hidden && i < semantic_rows) std::copy_n(round.hidden.row(i), round.hidden.cols, trace.hidden.row(m));
      if (fills_feature) std::copy_n(round.out.feature.row(i), trace.out.feature.cols, trace.out.feature.row(m));
      next(r, 0) = static_cast<std::int32_t>(m + 1);
    }
  }
}

template <class Real>
void Pass<Real>::composite(const StepContext& ctx, int lane, PassTrace<Real>& trace) const {
  const std::int64_t ray_count = trace.samples.first.rows - 1;
  const std::int64_t labelled = branch_ ? 0 : trace.semantic_rays;  // the branch follows the weights
  const bool deferred = rules_.deferred_class_layer;
  check_density<Real>(trace.samples, trace.sigma, ctx.first_ray);
  if (labelled > 0 && !deferred) {
    parts_.head->class_forward(ctx, store_->tensors(head_, lane), trace.hidden, {}, trace.sample_logits);
  }
  const auto run = [&](std::int64_t begin, std::int64_t count, bool with_semantics) {
    if (count == 0) return;
    const RayGroup<Real> group(trace, rules_, begin, count, with_semantics);
    composite_forward<Real>(group.in, group.out);
  };
  run(0, labelled, true);
  run(labelled, ray_count - labelled, false);
  if (labelled > 0 && deferred) {
    parts_.head->class_forward(ctx, store_->tensors(head_, lane), trace.ray_hidden,
                               trace.opacity.row_range(0, labelled), trace.logits);
  }
  const RayGuard<Real> guard(parts_.name, ctx.first_ray, trace.samples);
  guard.per_ray("colour", trace.color);
  guard.per_ray("depth", trace.depth);
  guard.per_ray("opacity", trace.opacity);
}

template <class Real>
void Pass<Real>::backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace, const RayGradients<Real>& d,
                          View<const Real> d_logits, View<Real> d_encoded) const {
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const std::int64_t count = trace.samples.count;
  const std::int64_t ray_count = trace.samples.first.rows - 1;
  const bool by_branch = branch_.has_value();
  const std::int64_t labelled = d_logits.empty() || by_branch ? 0 : trace.semantic_rays;
  if (count == 0) return;
  if (by_branch && !d_logits.empty()) branch_backward(ctx, lane, trace, d_logits);
  const Tensors<Real> head = head_ < 0 ? Tensors<Real>{} : store_->tensors(head_, lane);
  View<Real> d_sigma = arena.take<Real>(count, 1);
  View<Real> d_rgb = arena.take<Real>(count, 3);
  View<Real> d_per_sample, d_ray_hidden, d_opacity;
  const bool deferred = rules_.deferred_class_layer;
  if (labelled > 0) {
    d_per_sample =
        arena.take<Real>(trace.semantic_samples, deferred ? parts_.head->hidden_width() : parts_.head->classes());
    if (deferred) {
      d_ray_hidden = arena.take<Real>(labelled, parts_.head->hidden_width());
      d_opacity = arena.take<Real>(labelled, 1);
      parts_.head->class_backward(ctx, head, trace.ray_hidden, trace.opacity.row_range(0, labelled), d_logits,
                                  d_ray_hidden, d_opacity);
    }
  }
  const auto run = [&](std::int64_t begin, std::int64_t rays, bool with_semantics) {
    if (rays == 0) return;
    const RayGroup<Real> group(trace, rules_, begin, rays, with_semantics);
    CompositeGrad<Real> grad;
    grad.color = d.color.row_range(begin, rays);
    grad.depth = d.depth.row_range(begin, rays);
    grad.weight = d.weight;
    View<Real> d_hidden;
    if (with_semantics) {
      grad.hidden = deferred ? View<const Real>(d_ray_hidden) : d_logits;
      grad.hidden_moves_density = !rules_.stop_gradient_to_density;
      if (deferred && grad.hidden_moves_density) grad.opacity = d_opacity;
      d_hidden = d_per_sample;
    }
    composite_backward<Real>(group.in, group.out, grad, d_sigma, d_rgb, d_hidden);
  };
  run(0, labelled, true);
  run(labelled, ray_count - labelled, false);
  View<Real> d_feature;
  if (labelled > 0) {
    View<Real> d_hidden = d_per_sample;
    const View<const Real> hidden = trace.hidden;
    if (!deferred) {
      d_hidden = arena.take<Real>(trace.semantic_samples, parts_.head->hidden_width());
      parts_.head->class_backward(ctx, head, hidden, {}, d_per_sample, d_hidden, {});
    }
    d_feature = arena.take<Real>(count, parts_.field->traits().feature_dims);
    fill_zero(d_feature.row_range(trace.semantic_samples, count - trace.semantic_samples));
    parts_.head->hidden_backward(ctx, head, trace.out.feature.row_range(0, trace.semantic_samples), hidden, d_hidden,
                                 d_feature.row_range(0, trace.semantic_samples));
  }
  for (std::int64_t m = 0; m < count && !d.sigma.empty(); ++m) d_sigma(m, 0) += d.sigma(m, 0);
  View<Real> d_raw = d_sigma;
  density_backward<Real>(rules_.activation, trace.out.sigma, d_sigma, d_raw);
  FieldGrad<Real> grad;
  grad.sigma = d_raw;
  grad.rgb = d_rgb;
  grad.feature = d_feature;
  const View<const std::int32_t> ray_of_sample = trace.samples.ray_of_sample.row_range(0, count);
  parts_.field->backward(ctx, store_->tensors(field_, lane), {trace.encoded, trace.direction, ray_of_sample}, trace.out,
                         grad, trace.saved, d_encoded);
}

template <class Real>
void Pass<Real>::scatter(const StepContext& ctx, View<const double> x, View<const Real> dy) const {
  if (x.rows == 0) return;
  parts_.position->backward(ctx, store_->tensors(position_), x, dy, {});
}

template class Pass<float>;
template class Pass<double>;

}  // namespace semfield
