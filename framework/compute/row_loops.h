// The few memory-bound loops around layers (compute/layers.h).
#pragma once

#include "core/view.h"

namespace semfield {

/// dy = y > 0 ? dy : 0, in place: gradient after a ReLU to gradient before it.
template <class Real>
void relu_backward(View<const Real> y, View<Real> dy);

/// out [cols, rows] = in^T.
template <class Real>
void transpose(View<const Real> in, View<Real> out);

/// Row-wise copy between strided matrices of one shape.
template <class Real>
void copy_rows(View<const Real> in, View<Real> out);
template <class Real>
void fill(View<Real> out, Real value);

#define SEMFIELD_ROW_LOOPS_OF(prefix, Real)                               \
  prefix template void relu_backward<Real>(View<const Real>, View<Real>); \
  prefix template void transpose<Real>(View<const Real>, View<Real>);     \
  prefix template void copy_rows<Real>(View<const Real>, View<Real>);     \
  prefix template void fill<Real>(View<Real>, Real);

SEMFIELD_ROW_LOOPS_OF(extern, float)
SEMFIELD_ROW_LOOPS_OF(extern, double)

}  // namespace semfield
