// Rendering that ends a ray where nothing behind can be seen.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "model/pass.h"

namespace semfield {

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

template void Pass<float>::evaluate_in_rounds(const StepContext&, int, PassTrace<float>&, bool) const;
template void Pass<double>::evaluate_in_rounds(const StepContext&, int, PassTrace<double>&, bool) const;

}  // namespace semfield
