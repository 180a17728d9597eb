// Density asked for by position: what samplers observe, and what meshes are made of.
#include <algorithm>

#include "model/pass.h"

namespace semfield {

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
    const View<double> x = arena.take<double>(count, 3);
    stages_->map_positions(places, parts_.domain, x);
    const View<Real> encoded = arena.take<Real>(count, encoded_dims());
    parts_.position->forward(ctx, store_->tensors(position_), x, encoded);
    const View<Real> raw = arena.take<Real>(count, 1);
    FieldIn<Real> in;
    in.position = encoded;
    FieldOut<Real> out;
    out.sigma = raw;
    parts_.field->forward(ctx, store_->tensors(field_), in, out, {});
    const View<Real> found = sigma.row_range(begin, count);
    stages_->density_forward(rule, nullptr, raw, found);
    if (stages_->guard_density_at != nullptr) stages_->guard_density_at(places, raw, found);
  }
}

template <class Real>
void Pass<Real>::observe(const StepContext& ctx, WorkspacePool* queries) const {
  if (!parts_.sampler->traits().observes) return;
  parts_.sampler->observe(ctx, store_->tensors(sampler_), [&](View<const double> positions, View<Real> sigma) {
    StepContext local = ctx;
    std::optional<WorkspacePool::Loan> arena;
    if (queries != nullptr) local.workspace = arena.emplace(*queries).get();
    density(local, positions, sigma);
  });
}

#define SEMFIELD_INSTANTIATE(Real)                                                             \
  template void Pass<Real>::density(const StepContext&, View<const double>, View<Real>) const; \
  template void Pass<Real>::observe(const StepContext&, WorkspacePool*) const;
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
