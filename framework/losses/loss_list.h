// The terms of a configuration's list `losses`: which of them work in a step, how their means are scaled, and their
// sums.
#pragma once

#include <array>
#include <memory>
#include <string>
#include <vector>

#include "losses/loss_term.h"

namespace semfield {

/// More cannot stand in a list: a type stands there once.
inline constexpr std::size_t kMostLossTerms = 8;

/// Numbers a term, in the order of the list.
using LossNumbers = std::array<double, kMostLossTerms>;

struct LossEntry {
  std::string type;
  std::shared_ptr<LossTerm> term;
  std::string where;  ///< its place in the configuration, for messages
};

/// What a step does with a batch.
struct LossScales {
  std::uint32_t active = 0;  ///< bit i: term i works in this step
  LossNumbers count{};       ///< rays that its mean is over
  LossNumbers scale{};       ///< weight / count; 0 without a ray
};

class LossList {
 public:
  LossList() = default;
  explicit LossList(std::vector<LossEntry> entries) : entries_(std::move(entries)) {}

  const std::vector<LossEntry>& entries() const { return entries_; }
  bool empty() const { return entries_.empty(); }
  /// Of all terms together, or of the active ones.
  LossTraits traits(std::uint32_t active = ~0U) const;
  LossScales scales(std::uint32_t active, const RayTargets& batch, std::int64_t rays) const;
  /// Adds the active terms' gradients; `sums` gets each one's sum, before weight and division, added.
  template <class Real>
  void add(const LossScales& scales, const RayTargets& targets, const RayValues<Real>& values,
           const RayGradients<Real>& gradients, LossNumbers& sums) const;
  /// Sums of a step to means; returns their weighted total.
  double finish(const LossScales& scales, LossNumbers& sums) const;

 private:
  std::vector<LossEntry> entries_;
};

}  // namespace semfield
