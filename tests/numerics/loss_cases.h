// What the files of group D share.
#pragma once

#include <utility>

#include "core/view.h"
#include "named_case.h"

namespace semfield::numerics {

/// |got - want| / |want| beyond `quanta` of the smallest number of Real: what lies below the normal range has fewer
/// digits, or none.
template <class Real>
double error_above_quantum(long double got, long double want, double quanta = 0.51) {
  const auto quantum = static_cast<long double>(std::numeric_limits<Real>::denorm_min());
  const long double off = std::abs(got - want) - quantum * static_cast<long double>(quanta);
  if (std::isnan(off)) return std::numeric_limits<double>::infinity();
  return off <= 0 ? 0.0 : relative_error(off + std::abs(want), std::abs(want));
}

template <class Real>
View<const Real> row_of(const std::vector<Real>& values) {
  return {values.data(), 1, static_cast<std::int32_t>(values.size())};
}
template <class Real>
View<Real> row_of(std::vector<Real>& values) {
  return {values.data(), 1, static_cast<std::int32_t>(values.size())};
}

}  // namespace semfield::numerics
