// Numbers that are joined into sets.
#pragma once

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <vector>

namespace semfield {

/// The numbers below `count`, a set each at first. The least number of a set stands for it, so the result does not
/// depend on the order in which numbers are joined.
class JoinedSets {
 public:
  explicit JoinedSets(std::size_t count) : up_(count) { std::iota(up_.begin(), up_.end(), 0U); }
  template <class Number>
  Number of(Number i) {
    auto at = static_cast<std::size_t>(i);
    while (up_[at] != at) at = up_[at] = up_[up_[at]];  // paths halved
    return static_cast<Number>(at);
  }
  template <class Number>
  void join(Number a, Number b) {
    const auto x = static_cast<std::uint32_t>(of(a)), y = static_cast<std::uint32_t>(of(b));
    up_[std::max(x, y)] = std::min(x, y);
  }

 private:
  std::vector<std::uint32_t> up_;
};

}  // namespace semfield
