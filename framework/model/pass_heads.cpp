// What stands behind branches of its own: class logits where they do, and the channels of the other heads.
#include <algorithm>

#include "model/pass.h"

namespace semfield {

template <class Real>
bool Pass<Real>::heads_want_feature() const {
  return std::any_of(heads_.begin(), heads_.end(),
                     [](const auto& head) { return head.branch().rules().reads_feature; });
}

template <class Real>
BranchCall<Real> Pass<Real>::branch_call(const Rays<Real>& rays, const PassTrace<Real>& trace,
                                         std::int64_t count) const {
  const std::int64_t most = count == trace.semantic_rays ? trace.semantic_samples : trace.samples.count;
  return {&rays, &trace.samples, trace.weight, trace.out.feature, count, most};
}

template <class Real>
void Pass<Real>::branch_forward(const StepContext& ctx, int lane, const Rays<Real>& rays,
                                PassTrace<Real>& trace) const {
  trace.semantic = branched_->forward(ctx, lane, branch_call(rays, trace, trace.semantic_rays));
}

template <class Real>
void Pass<Real>::branch_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace,
                                 View<const Real> d_logits) const {
  branched_->backward(ctx, lane, trace.semantic, d_logits);
}

template <class Real>
void Pass<Real>::heads_forward(const StepContext& ctx, int lane, const Rays<Real>& rays, PassTrace<Real>& trace) const {
  for (std::size_t i = 0; i < heads_.size(); ++i)
    trace.heads[i] = heads_[i].forward(ctx, lane, branch_call(rays, trace, rays.origin.rows));
}

template <class Real>
void Pass<Real>::heads_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace,
                                const ChannelTable<const Real>& d_heads) const {
  for (std::size_t i = 0; i < heads_.size(); ++i)
    heads_[i].backward(ctx, lane, trace.heads[i], d_heads[parts_.heads[i].channel]);
}

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

template <class Real>
View<Real> Pass<Real>::axes(std::string_view channel) const {
  for (std::size_t i = 0; i < heads_.size(); ++i)
    if (parts_.heads[i].channel == channel && axes_[i] >= 0) return store_->tensors(axes_[i]).value[0];
  return {};
}

#define SEMFIELD_INSTANTIATE(Real)                                                                                    \
  template bool Pass<Real>::heads_want_feature() const;                                                               \
  template void Pass<Real>::branch_forward(const StepContext&, int, const Rays<Real>&, PassTrace<Real>&) const;       \
  template void Pass<Real>::branch_backward(const StepContext&, int, const PassTrace<Real>&, View<const Real>) const; \
  template void Pass<Real>::heads_forward(const StepContext&, int, const Rays<Real>&, PassTrace<Real>&) const;        \
  template void Pass<Real>::heads_backward(const StepContext&, int, const PassTrace<Real>&,                           \
                                           const ChannelTable<const Real>&) const;                                    \
  template RayValues<Real> Pass<Real>::values_of(View<const double>, const PassTrace<Real>&) const;                   \
  template View<Real> Pass<Real>::axes(std::string_view) const;
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
