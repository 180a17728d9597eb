// Proposals for the importance sampler.
#pragma once

#include "ray_bench.h"

namespace semfield::numerics {

/// What an earlier pass left on one ray: places and weights.
template <class Real>
struct Earlier {
  Earlier(std::vector<Real> places, std::vector<Real> weights) : t(std::move(places)), weight(std::move(weights)) {
    const auto n = static_cast<std::int64_t>(t.size());
    first = {0, static_cast<std::int32_t>(n)};
    samples = {View<Real>(t.data(), n, 1), View<Real>(t.data(), n, 1), {}, View<std::int32_t>(first.data(), 2, 1), n};
    proposal = {&samples, View<const Real>(weight.data(), n, 1)};
  }
  Earlier(const Earlier&) = delete;
  Earlier& operator=(const Earlier&) = delete;
  std::int64_t count() const { return static_cast<std::int64_t>(t.size()); }
  std::vector<Real> t, weight;
  std::vector<std::int32_t> first;
  Samples<Real> samples;
  Proposal<Real> proposal;
};

/// Places in the middle of as many equal bins as there are weights.
template <class Real>
std::vector<Real> bin_middles(double near_m, double far_m, std::size_t bins) {
  std::vector<Real> t;
  for (std::size_t k = 0; k < bins; ++k)
    t.push_back(
        static_cast<Real>(near_m + (far_m - near_m) * (static_cast<double>(k) + 0.5) / static_cast<double>(bins)));
  return t;
}

}  // namespace semfield::numerics
