// The formulas of the generalised cross-entropy, for CPU and GPU.
#pragma once

#include <cmath>

#include "core/host_device.h"

namespace semfield {

/// p^q of a class whose logit lies `below` the row's largest, of which `total` = sum of e^(s_c - largest).
SEMFIELD_HD inline double power_of_probability(double below, double total, double q) {
  return std::exp(q * (below - std::log(total)));
}

/// What a class with label share t adds to the loss of its row: t (1 - p^q) / q [Zhang18 Eq. 6].
SEMFIELD_HD inline double generalised_share(double t, double power, double q) { return t * (1 - power) / q; }

/// dL/d(s_c) = p_c A - t_c p_c^q, A = sum over classes of t p^q.
SEMFIELD_HD inline double generalised_slope(double p, double sum_of_powers, double t, double power) {
  return p * sum_of_powers - t * power;
}

}  // namespace semfield
