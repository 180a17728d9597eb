// Values by their rank.
#pragma once

#include <algorithm>
#include <cstddef>
#include <iterator>
#include <vector>

namespace semfield {

/// The middle value, of an even number the upper one; 0 of none.
template <class T>
T median_of(std::vector<T> values) {
  if (values.empty()) return T(0);
  const auto middle = values.begin() + std::ssize(values) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}
/// The value of rank floor(share * (n - 1)), share 0 to 1. Reorders `values`, which are not empty.
template <class T>
T quantile(std::vector<T>& values, double share) {
  const auto at = values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

}  // namespace semfield
