// Formulas of the NeRF network that are not matrix products.
#pragma once

#include "core/host_device.h"

namespace semfield {

/// d sigmoid(x) / dx from y = sigmoid(x): y (1 - y).
template <class Real>
SEMFIELD_HD inline Real nerf_mlp_sigmoid_slope(Real y) {
  return y * (Real(1) - y);
}

}  // namespace semfield
