// Kernel table of the identity encoder.
#pragma once

#include "core/view.h"

namespace semfield {

class KernelTables;

template <class Real>
struct IdentityKernels {
  /// Returns the first row with a coordinate that is not finite, or -1.
  std::int64_t (*forward)(View<const double> x, View<Real> y) = nullptr;
  void (*backward)(View<const Real> dy, View<Real> dx) = nullptr;
};

void identity_kernels(KernelTables& tables);

}  // namespace semfield
