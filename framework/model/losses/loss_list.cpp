#include "model/losses/loss_list.h"

#include <algorithm>

#include "core/check.h"

namespace semfield {

namespace {
// Of the pass itself; every other channel is a head's.
bool of_pass(std::string_view name) {
  constexpr std::array kOfPass{channel::color, channel::depth, channel::weight, channel::sigma};
  return std::find(kOfPass.begin(), kOfPass.end(), name) != kOfPass.end();
}
}  // namespace

bool reads_heads(const LossTraits& traits) {
  return std::any_of(traits.heads.begin(), traits.heads.end(), [](auto name) { return name != channel::logits; });
}

LossList::LossList(std::vector<LossEntry> entries) : entries_(std::move(entries)) {
  SEMFIELD_CHECK(entries_.size() <= kMostLossTerms, "too many losses");
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    const LossTraits& traits = traits_.emplace_back(entries_[i].loss->traits());
    const auto own = std::count_if(traits.moves.begin(), traits.moves.end(), of_pass);
    const bool logits = traits.does_move(channel::logits), one_kind = own == 0 || own == std::ssize(traits.moves);
    if (!one_kind || (logits && traits.moves.size() > 1))
      throw Error(
          ErrorKind::config, "plugin.loss.channels",
          "losses: '" + entries_[i].type +
              "' moves channels whose gradients are made apart: class logits, channels of other heads, and those "
              "of the pass itself",
          "make a loss for each of them");
    if (logits) on_logits_ |= 1U << i;
    if (own == 0 && !logits) on_heads_ |= 1U << i;
    if (reads_heads(traits)) reading_heads_ |= 1U << i;
  }
}

std::uint32_t LossList::moving(std::string_view channel) const {
  std::uint32_t bits = 0;
  for (std::size_t i = 0; i < traits_.size(); ++i) bits |= traits_[i].does_move(channel) ? 1U << i : 0U;
  return bits;
}

LossScales LossList::scales(std::uint32_t active, const RayTargets& batch, std::int64_t rays) const {
  LossScales out;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    if ((active >> i & 1U) == 0) continue;
    const Loss& loss = *entries_[i].loss;
    out.active |= 1U << i;
    out.count[i] = static_cast<double>(loss.counted_rays(batch, rays));
    out.scale[i] = out.count[i] > 0 ? loss.rule().weight / out.count[i] : 0;
  }
  return out;
}

template <class Real>
void LossList::add(std::uint32_t which, const LossScales& scales, const RayTargets& targets,
                   const RayValues<Real>& values, const RayGradients<Real>& gradients, LossNumbers& sums) const {
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    if ((which >> i & 1U) != 0) sums[i] += entries_[i].loss->add(targets, values, scales.scale[i], gradients);
  }
}

double LossList::finish(const LossScales& scales, LossNumbers& sums) const {
  double total = 0;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    sums[i] = scales.count[i] > 0 ? sums[i] / scales.count[i] : 0;
    total += entries_[i].loss->rule().weight * sums[i];
  }
  return total;
}

template void LossList::add<float>(std::uint32_t, const LossScales&, const RayTargets&, const RayValues<float>&,
                                   const RayGradients<float>&, LossNumbers&) const;
template void LossList::add<double>(std::uint32_t, const LossScales&, const RayTargets&, const RayValues<double>&,
                                    const RayGradients<double>&, LossNumbers&) const;

}  // namespace semfield
