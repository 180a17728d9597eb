// The functions of group D's cases, and what they share.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

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

// cross_entropy_cases.cpp
void logit_sweep(CaseRun& run);
void infinite_logit(CaseRun& run);
void one_hot_entropy(CaseRun& run);
void one_class(CaseRun& run);
void one_labelled(CaseRun& run);
void soft_labels(CaseRun& run);
void class_weights(CaseRun& run);
void double_softmax(CaseRun& run);
// label_cases.cpp
void all_void(CaseRun& run);
void label_range(CaseRun& run);
// semantic_ray_cases.cpp
void empty_ray(CaseRun& run);
void half_opacity(CaseRun& run);
void detached(CaseRun& run);
// activation_cases.cpp
void saturated_sigmoid(CaseRun& run);
void hdr_target(CaseRun& run);
void density_activations(CaseRun& run);
void large_exponents(CaseRun& run);
// dead_start_case.cpp
void dead_start(CaseRun& run);

}  // namespace semfield::numerics
