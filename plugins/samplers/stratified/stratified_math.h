// Formulas of the stratified sampler, for host and device.
#pragma once

#include <cstdint>

#include "core/host_device.h"

namespace semfield {

/// t_k = near + (far - near) (k + u) / N, k = 0..N-1, u in [0, 1) [Mildenhall20 Eq. 2].
SEMFIELD_HD inline double stratum_point(double near_m, double far_m, std::int64_t k, double u, std::int64_t n) {
  return near_m + (far_m - near_m) * ((static_cast<double>(k) + u) / static_cast<double>(n));
}

}  // namespace semfield
