// The losses of a configuration's list `losses`: which of them work in a step, how their means are scaled, and their
// sums.
#pragma once

#include <array>
#include <memory>
#include <string>
#include <vector>

#include "plugin/registry.h"

namespace semfield {

/// More cannot stand in a list.
inline constexpr std::size_t kMostLossTerms = 8;

/// Numbers per loss, in the order of the list.
using LossNumbers = std::array<double, kMostLossTerms>;

struct LossEntry {
  std::string type;
  std::shared_ptr<const Loss> loss;
  std::shared_ptr<PluginParams> params;  ///< that it was made of
  std::string where;                     ///< its place in the configuration, for messages
};

/// Whether a loss reads channels of other heads than that of the logits.
bool reads_heads(const LossTraits& traits);

/// What a step does with a batch.
struct LossScales {
  std::uint32_t active = 0;  ///< bit i: loss i works in this step
  LossNumbers count{};       ///< rays that its mean is over
  LossNumbers scale{};       ///< weight / count; 0 without a ray
};

class LossList {
 public:
  LossList() = default;
  /// Throws Error(config) for a loss that moves logits and another channel, or a channel of a head and one of the pass.
  explicit LossList(std::vector<LossEntry> entries);

  const std::vector<LossEntry>& entries() const { return entries_; }
  bool empty() const { return entries_.empty(); }
  /// Bits of the losses that move the channel.
  std::uint32_t moving(std::string_view channel) const;
  /// Bits of the losses that move the logits, and of those that move channels of other heads.
  std::uint32_t on_logits() const { return on_logits_; }
  std::uint32_t on_heads() const { return on_heads_; }
  /// Bits of the losses that read channels of other heads than that of the logits.
  std::uint32_t reading_heads() const { return reading_heads_; }
  LossScales scales(std::uint32_t active, const RayTargets& batch, std::int64_t rays) const;
  /// Adds the gradients of the losses whose bit is set in `which`; `sums` gets each one's sum, before weight and
  /// division, added.
  template <class Real>
  void add(std::uint32_t which, const LossScales& scales, const RayTargets& targets, const RayValues<Real>& values,
           const RayGradients<Real>& gradients, LossNumbers& sums) const;
  /// Sums of a step to means; returns their weighted total.
  double finish(const LossScales& scales, LossNumbers& sums) const;

 private:
  std::vector<LossEntry> entries_;
  std::vector<LossTraits> traits_;
  std::uint32_t on_logits_ = 0, on_heads_ = 0, reading_heads_ = 0;
};

}  // namespace semfield
