#include "model/semantic_branch.h"

#include <algorithm>

#include "core/error.h"
#include "model/ray_guard.h"

namespace semfield {

template <class Real>
SemanticBranch<Real>::SemanticBranch(const SemanticBranchParts<Real>& parts, const std::string& pass,
                                     ParamStore<Real>& store)
    : parts_(&parts), store_(&store) {
  const std::size_t before = store.all().size();
  position_ = store.add(pass + "/semantic/position", *parts_->position);
  for (std::size_t i = before; i < store.all().size(); ++i) {
    if (!store.all()[i].learned()) continue;
    throw Error(ErrorKind::config,
                "pass '" + pass +
                    "': the position encoder of its semantic branch has learned tensors, and the branch is to be "
                    "smoother than such tables",
                "choose an encoder without learned tensors: one_blob or frequency");
  }
  field_ = store.add(pass + "/semantic/field", *parts_->field, parts_->rules.learning());
}

template <class Real>
void SemanticBranch<Real>::derive(const StepContext& ctx) const {
  parts_->position->derive(ctx, store_->tensors(position_));
  parts_->field->derive(ctx, store_->tensors(field_));
}

template <class Real>
void SemanticBranch<Real>::derive_backward(const StepContext& ctx) const {
  parts_->position->derive_backward(ctx, store_->tensors(position_));
  parts_->field->derive_backward(ctx, store_->tensors(field_));
}

template <class Real>
void SemanticBranch<Real>::keep(const Samples<Real>& samples, View<const Real> weight, std::int64_t semantic_rays,
                                Workspace& arena, SemanticBranchTrace<Real>& trace) const {
  const auto least = static_cast<Real>(parts_->rules.least_weight);
  const std::int32_t all = samples.first(semantic_rays, 0);
  trace.samples.first = arena.take<std::int32_t>(semantic_rays + 1, 1);
  trace.share = arena.take<Real>(semantic_rays, 1);
  const auto kept = static_cast<std::int64_t>(
      std::count_if(weight.data, weight.data + all, [least](Real w) { return w >= least && w > 0; }));
  trace.samples.ray_of_sample = arena.take<std::int32_t>(kept, 1);
  trace.source = arena.take<std::int32_t>(kept, 1);
  trace.weight = arena.take<Real>(kept, 1);
  std::int32_t k = 0;
  for (std::int64_t r = 0; r < semantic_rays; ++r) {
    trace.samples.first(r, 0) = k;
    Real share = 0;
    for (std::int32_t m = samples.first(r, 0); m < samples.first(r + 1, 0); ++m) {
      const Real w = weight(m, 0);
      if (!(w >= least && w > 0)) continue;
      trace.samples.ray_of_sample(k, 0) = static_cast<std::int32_t>(r);
      trace.source(k, 0) = m;
      trace.weight(k, 0) = w;
      share += w;
      ++k;
    }
    trace.share(r, 0) = share;
  }
  trace.samples.first(semantic_rays, 0) = k;
  trace.samples.count = k;
}

template <class Real>
SemanticBranchTrace<Real> SemanticBranch<Real>::forward(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                                        const Samples<Real>& samples, View<const Real> weight,
                                                        View<const Real> feature, std::int64_t semantic_rays) const {
  Workspace& arena = *ctx.workspace;
  SemanticBranchTrace<Real> trace;
  keep(samples, weight, semantic_rays, arena, trace);
  const std::int64_t kept = trace.samples.count;
  const std::int32_t encoded = parts_->position->traits().out_dims;
  const std::int32_t read = parts_->rules.reads_feature ? feature.cols : 0;
  trace.input = arena.take<Real>(kept, encoded + read);
  trace.out.feature = trace.feature = arena.take<Real>(kept, feature_dims());
  if (ctx.training && parts_->rules.dropout > 0) trace.feature = arena.take<Real>(kept, feature_dims());
  if (ctx.training) {
    const std::size_t bytes = parts_->field->saved_bytes(kept, semantic_rays);
    trace.saved = Saved(arena.take_bytes(bytes), bytes);
  }
  if (kept == 0) return trace;
  const Workspace::Scope scope(arena);
  const View<double> x = arena.take<double>(kept, 3);
  for (std::int64_t k = 0; k < kept; ++k) {
    const std::int64_t r = trace.samples.ray_of_sample(k, 0), m = trace.source(k, 0);
    const double t = static_cast<double>(samples.t(m, 0));
    Vec3d p;
    for (int i = 0; i < 3; ++i) p[i] = rays.origin(r, i) + t * rays.direction(r, i);
    const Vec3d at = parts_->domain(p);
    for (int i = 0; i < 3; ++i) x(k, i) = at[i];
    for (std::int32_t c = 0; c < read; ++c) trace.input(k, encoded + c) = feature(m, c);
  }
  const View<Real> position = arena.take<Real>(kept, encoded);
  parts_->position->forward(ctx, store_->tensors(position_, lane), x, position);
  for (std::int64_t k = 0; k < kept; ++k) std::copy_n(position.row(k), encoded, trace.input.row(k));
  FieldIn<Real> in;
  in.position = trace.input;
  in.ray_of_sample = trace.samples.ray_of_sample;
  parts_->field->forward(ctx, store_->tensors(field_, lane), in, trace.out, trace.saved);
  if (trace.feature.data != trace.out.feature.data) {
    std::copy_n(trace.out.feature.data, trace.feature.size(), trace.feature.data);
    drop_out(ctx, trace, trace.feature);
  }
  return trace;
}

template <class Real>
void SemanticBranch<Real>::backward(const StepContext& ctx, int lane, const SemanticBranchTrace<Real>& trace,
                                    View<Real> d_feature) const {
  if (trace.samples.count == 0) return;
  drop_out(ctx, trace, d_feature);
  FieldIn<Real> in;
  in.position = trace.input;
  in.ray_of_sample = trace.samples.ray_of_sample;
  FieldGrad<Real> grad;
  grad.feature = d_feature;
  parts_->field->backward(ctx, store_->tensors(field_, lane), in, trace.out, grad, trace.saved, {});
}

template <class Real>
void SemanticBranch<Real>::drop_out(const StepContext& ctx, const SemanticBranchTrace<Real>& trace,
                                    View<Real> values) const {
  const double share = parts_->rules.dropout;
  if (!ctx.training || share <= 0) return;
  const RandomAddress address = ctx.random(kBranchDropout);
  for (std::int64_t k = 0; k < trace.samples.count; ++k) {
    const std::int32_t ray = trace.samples.ray_of_sample(k, 0);
    const std::int64_t of_ray = k - trace.samples.first(ray, 0);
    Real* const row = values.row(k);
    for (std::int32_t c = 0; c < values.cols; c += kDropoutGroup) {
      const DropoutFactors factors =
          dropout_factors(address, share, ctx.first_ray + ray, of_ray, c / kDropoutGroup, values.cols);
      for (std::int32_t i = 0; i < std::min(kDropoutGroup, values.cols - c); ++i)
        row[c + i] *= static_cast<Real>(factors.of[i]);
    }
  }
}

template <class Real>
void sum_by_weight(const Samples<Real>& samples, View<const Real> weight, View<const Real> values, View<Real> out) {
  for (std::int64_t r = 0; r < out.rows; ++r) {
    Real* const sum = out.row(r);
    std::fill_n(sum, out.cols, Real(0));
    for (std::int32_t k = samples.first(r, 0); k < samples.first(r + 1, 0); ++k) {
      const Real* const value = values.row(k);
      const Real w = weight(k, 0);
      for (std::int32_t c = 0; c < out.cols; ++c) sum[c] += w * value[c];
    }
  }
}

template <class Real>
void sum_by_weight_backward(const Samples<Real>& samples, View<const Real> weight, View<const Real> d_out,
                            View<Real> d_values) {
  for (std::int64_t k = 0; k < samples.count; ++k) {
    const Real* const d = d_out.row(samples.ray_of_sample(k, 0));
    const Real w = weight(k, 0);
    for (std::int32_t c = 0; c < d_values.cols; ++c) d_values(k, c) = w * d[c];
  }
}

#define SEMFIELD_INSTANTIATE(Real)                                                                         \
  template class SemanticBranch<Real>;                                                                     \
  template void sum_by_weight<Real>(const Samples<Real>&, View<const Real>, View<const Real>, View<Real>); \
  template void sum_by_weight_backward<Real>(const Samples<Real>&, View<const Real>, View<const Real>, View<Real>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
