// CPU kernels of the identity encoder: one row at a time, memory-bound.
#include <cmath>

#include "compute/isa.h"
#include "encoders/identity/identity_kernels.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

namespace {

template <class Real>
std::int64_t forward(const IdentityShape&, View<const double> x, View<Real> y) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    bool finite = true;
    for (std::int32_t c = 0; c < x.cols; ++c) {
      finite = finite && std::isfinite(x(r, c));
      y(r, c) = static_cast<Real>(x(r, c));
    }
    if (!finite) return r;
  }
  return -1;
}

template <class Real>
void backward(const IdentityShape&, View<const double>, View<const Real> dy, View<Real> dx) {
  for (std::int64_t r = 0; r < dy.rows; ++r) {
    for (std::int32_t c = 0; c < dy.cols; ++c) dx(r, c) = dy(r, c);
  }
}

template <class Real>
const RowKernels<Real, IdentityShape> kTable{forward<Real>, backward<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(identity, "encoder 'identity'", kTable)

}  // namespace semfield::SEMFIELD_ISA
