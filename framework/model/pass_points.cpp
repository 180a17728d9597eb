// What is asked for by position and not along rays: density, of which samplers and meshes are made, and semantics,
// where a point is a sample of weight 1.
#include <algorithm>
#include <numeric>

#include "core/check.h"
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
void Pass<Real>::observe(const StepContext& ctx, const DensityQuery<Real>& query) const {
  if (parts_.sampler->traits().observes) parts_.sampler->observe(ctx, store_->tensors(sampler_), query);
}

template <class Real>
void Pass<Real>::observe(const StepContext& ctx) const {
  observe(ctx, [&](View<const double> positions, View<Real> sigma) { density(ctx, positions, sigma); });
}

template <class Real>
void Pass<Real>::point_colors(const StepContext& ctx, View<const double> positions, View<const double> directions,
                              View<Real> color) const {
  SEMFIELD_CHECK(stages_->host_memory, "colours of points are the CPU's");
  if (positions.rows == 0) return;
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const View<double> x = arena.take<double>(positions.rows, 3);
  stages_->map_positions(positions, parts_.domain, x);
  const View<Real> encoded = arena.take<Real>(positions.rows, encoded_dims());
  parts_.position->forward(ctx, store_->tensors(position_), x, encoded);
  FieldIn<Real> in;
  in.position = encoded;
  if (parts_.direction) {
    const View<Real> seen = arena.take<Real>(positions.rows, parts_.direction->traits().out_dims);
    parts_.direction->forward(ctx, store_->tensors(direction_), directions, seen);
    in.direction = seen;
    const View<std::int32_t> own = arena.take<std::int32_t>(positions.rows, 1);
    std::iota(own.data, own.data + own.rows, 0);
    in.ray_of_sample = own;
  }
  FieldOut<Real> out;
  out.sigma = arena.take<Real>(positions.rows, 1);
  out.rgb = color;
  parts_.field->forward(ctx, store_->tensors(field_), in, out, {});
}

template <class Real>
std::int32_t Pass<Real>::point_dims() const {
  const std::int32_t feature = parts_.field->traits().feature_dims;
  return branched_ ? branched_->branch().input_dims(feature) : feature;
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
    of_position = branched_->branch().input_dims(0);
    branched_->branch().encode_points(ctx, positions, rows);
    if (!branched_->branch().rules().reads_feature) return;
  }
  const View<double> x = arena.take<double>(positions.rows, 3);
  stages_->map_positions(positions, parts_.domain, x);
  const View<Real> encoded = arena.take<Real>(positions.rows, encoded_dims());
  parts_.position->forward(ctx, store_->tensors(position_), x, encoded);
  FieldIn<Real> in;
  in.position = encoded;
  FieldOut<Real> out;
  out.feature = rows.col_range(of_position, parts_.field->traits().feature_dims);
  parts_.field->forward(ctx, store_->tensors(field_), in, out, {});
}

template <class Real>
PointTrace<Real> Pass<Real>::point_forward(const StepContext& ctx, int lane, View<const Real> rows,
                                           View<Real> logits) const {
  PointTrace<Real> trace;
  if (branched_) {
    trace.branch = branched_->branch().forward_points(ctx, lane, rows);
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
  if (branched_) branched_->branch().backward(ctx, lane, trace.branch, d_feature);
}

#define SEMFIELD_INSTANTIATE(Real)                                                                                  \
  template void Pass<Real>::density(const StepContext&, View<const double>, View<Real>) const;                      \
  template void Pass<Real>::observe(const StepContext&, const DensityQuery<Real>&) const;                           \
  template void Pass<Real>::observe(const StepContext&) const;                                                      \
  template void Pass<Real>::point_colors(const StepContext&, View<const double>, View<const double>, View<Real>)    \
      const;                                                                                                        \
  template std::int32_t Pass<Real>::point_dims() const;                                                             \
  template void Pass<Real>::point_rows(const StepContext&, View<const double>, View<Real>) const;                   \
  template PointTrace<Real> Pass<Real>::point_forward(const StepContext&, int, View<const Real>, View<Real>) const; \
  template void Pass<Real>::point_backward(const StepContext&, int, const PointTrace<Real>&, View<const Real>) const;
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
