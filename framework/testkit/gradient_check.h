// Analytic gradients against central differences, in double.
#pragma once

#include <cstdint>
#include <functional>
#include <string>

#include "core/view.h"

namespace semfield::testkit {

struct GradientCheck {
  double tolerance = 1e-5;  ///< of the largest |gradient| in the matrix, or of `floor`
  double floor = 1e-6;
  int max_elements = 48;   ///< elements checked; the one with the largest gradient is always among them
  std::uint64_t seed = 1;  ///< which elements
};

/// Central differences of `loss` with respect to elements of `x` (changed and restored) against `analytic` of the same
/// shape. A step of 1e-6, its Richardson extrapolation and a step of 1e-7 are tried: a kink of the function within the
/// step, or a high frequency, spoils one of them but a wrong gradient spoils all. Returns "" or a sentence with the
/// worst element.
std::string check_gradient(const std::function<double()>& loss, View<double> x, View<const double> analytic,
                           const GradientCheck& options);

}  // namespace semfield::testkit
