#include "losses/loss_list.h"

#include "core/check.h"

namespace semfield {

void LossTerm::describe(ParamVisitor& visit) {
  LossRule& p = rule;
  SEMFIELD_PARAM(visit, p, weight, "factor of the term beside the colour loss", {0, 1e6});
  SEMFIELD_PARAM(visit, p, from_step,
                 "share of train.steps after which the term begins, and never before train.schedule.hold_steps",
                 {0, 1});
  describe_own(visit);
}

LossTraits LossList::traits(std::uint32_t active) const {
  LossTraits all;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    if ((active >> i & 1U) == 0) continue;
    const LossTraits own = entries_[i].term->traits();
    all.reads_depth |= own.reads_depth;
    all.moves_color |= own.moves_color;
    all.moves_depth |= own.moves_depth;
    all.moves_weight |= own.moves_weight;
    all.moves_sigma |= own.moves_sigma;
  }
  return all;
}

LossScales LossList::scales(std::uint32_t active, const RayTargets& batch, std::int64_t rays) const {
  SEMFIELD_CHECK(entries_.size() <= kMostLossTerms, "too many terms of the loss");
  LossScales out;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    if ((active >> i & 1U) == 0) continue;
    const LossTerm& term = *entries_[i].term;
    out.active |= 1U << i;
    out.count[i] = static_cast<double>(term.counted_rays(batch, rays));
    out.scale[i] = out.count[i] > 0 ? term.rule.weight / out.count[i] : 0;
  }
  return out;
}

template <class Real>
void LossList::add(const LossScales& scales, const RayTargets& targets, const RayValues<Real>& values,
                   const RayGradients<Real>& gradients, LossNumbers& sums) const {
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    if ((scales.active >> i & 1U) != 0) sums[i] += entries_[i].term->add(targets, values, scales.scale[i], gradients);
  }
}

double LossList::finish(const LossScales& scales, LossNumbers& sums) const {
  double total = 0;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    sums[i] = scales.count[i] > 0 ? sums[i] / scales.count[i] : 0;
    total += entries_[i].term->rule.weight * sums[i];
  }
  return total;
}

template void LossList::add<float>(const LossScales&, const RayTargets&, const RayValues<float>&,
                                   const RayGradients<float>&, LossNumbers&) const;
template void LossList::add<double>(const LossScales&, const RayTargets&, const RayValues<double>&,
                                    const RayGradients<double>&, LossNumbers&) const;

}  // namespace semfield
