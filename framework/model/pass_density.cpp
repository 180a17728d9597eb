// Density asked for by position: what samplers observe, and what meshes are made of.
#include <algorithm>
#include <cmath>
#include <string>

#include "core/error.h"
#include "model/pass.h"
#include "model/ray_guard.h"

namespace semfield {

namespace {

constexpr std::int64_t kDensityBatch = 1024;  // positions a query evaluates at once

// Densities asked for by position belong to no ray: the message names the place.
template <class Real>
void check_density_at(View<const double> positions, View<const Real> raw, View<const Real> sigma) {
  for (std::int64_t m = 0; m < sigma.rows; ++m) {
    if (std::isfinite(raw(m, 0)) && std::isfinite(sigma(m, 0))) continue;
    throw Error(ErrorKind::failure,
                "density at (" + std::to_string(positions(m, 0)) + ", " + std::to_string(positions(m, 1)) + ", " +
                    std::to_string(positions(m, 2)) + ") m is not finite (raw value " + std::to_string(raw(m, 0)) + ")",
                std::string(fault_remedy()));
  }
}

}  // namespace

template <class Real>
void Pass<Real>::density(const StepContext& ctx, View<const double> positions, View<Real> sigma) const {
  Workspace& arena = *ctx.workspace;
  for (std::int64_t begin = 0; begin < positions.rows; begin += kDensityBatch) {
    const std::int64_t count = std::min(kDensityBatch, positions.rows - begin);
    const Workspace::Scope scope(arena);
    View<double> x = arena.take<double>(count, 3);
    for (std::int64_t m = 0; m < count; ++m) {
      const Vec3d at = parts_.domain({positions(begin + m, 0), positions(begin + m, 1), positions(begin + m, 2)});
      for (int i = 0; i < 3; ++i) x(m, i) = at[i];
    }
    View<Real> encoded = arena.take<Real>(count, parts_.position->traits().out_dims);
    parts_.position->forward(ctx, store_->tensors(position_), x, encoded);
    View<Real> raw = arena.take<Real>(count, 1);
    FieldIn<Real> in;
    in.position = encoded;
    FieldOut<Real> out;
    out.sigma = raw;
    parts_.field->forward(ctx, store_->tensors(field_), in, out, {});
    for (std::int64_t m = 0; m < count; ++m) raw(m, 0) += static_cast<Real>(rules_.density_bias);
    const View<Real> out_rows = sigma.row_range(begin, count);
    density_forward<Real>(rules_.activation, raw, out_rows);
    check_density_at(positions.row_range(begin, count), View<const Real>(raw), View<const Real>(out_rows));
  }
}

template <class Real>
void Pass<Real>::observe(const StepContext& ctx) const {
  if (!parts_.sampler->traits().observes) return;
  parts_.sampler->observe(ctx, store_->tensors(sampler_), [this, ctx](View<const double> positions, View<Real> sigma) {
    static thread_local Workspace arena;
    StepContext local = ctx;
    local.workspace = &arena;
    density(local, positions, sigma);
  });
}

#define SEMFIELD_INSTANTIATE(Real)                                                             \
  template void Pass<Real>::density(const StepContext&, View<const double>, View<Real>) const; \
  template void Pass<Real>::observe(const StepContext&) const;
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
