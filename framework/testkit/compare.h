// Two matrices side by side: where they differ most, and by how much.
#pragma once

#include <string>

#include "core/view.h"

namespace semfield::testkit {

struct Difference {
  double max_abs = 0;    ///< largest |got - want|; infinity when exactly one of the two is not finite
  double max_want = 0;   ///< largest |want|
  std::int64_t row = 0;  ///< where max_abs is
  std::int32_t col = 0;
  double got = 0, want = 0;  ///< the values there
};

/// Element by element; the views have the same shape.
template <class A, class B>
Difference difference(View<const A> got, View<const B> want);

/// "" when max |got - want| <= tolerance * max(|want|, floor), else a sentence with the worst element.
template <class A, class B>
std::string compare(View<const A> got, View<const B> want, double tolerance, double floor = 1e-30);

/// "" when the norm of got - want is at most tolerance times the norm of want (roots of sums of squares): for
/// quantities with jumps, where single elements may differ by all they have.
template <class A, class B>
std::string compare_norms(View<const A> got, View<const B> want, double tolerance);

/// "" when every element has the same bits, else a sentence with the first element that has not.
template <class A>
std::string compare_bits(View<const A> got, View<const A> want);

}  // namespace semfield::testkit
