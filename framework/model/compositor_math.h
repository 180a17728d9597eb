// The formula of compositing that CPU and GPU share.
#pragma once

#include "core/host_device.h"

namespace semfield {

/// tau = sigma * delta; vacuum is vacuum over any distance, so that 0 * inf does not arise.
template <class Real>
SEMFIELD_HD inline double optical_depth(Real sigma, Real delta) {
  return sigma == Real(0) ? 0.0 : static_cast<double>(sigma) * static_cast<double>(delta);
}

}  // namespace semfield
