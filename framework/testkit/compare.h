// Two matrices side by side: where they differ most, and by how much.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include "core/check.h"
#include "core/non_copyable.h"
#include "core/view.h"
#include "plugin/parametric.h"

namespace semfield::testkit {

/// "1.25", and "element (3, 0)".
std::string shown_number(double value);
std::string shown_place(std::int64_t row, std::int32_t col);
/// "3 x 2"
std::string shown_shape(std::int64_t rows, std::int32_t cols);

/// "" for views of one shape, or both without elements, else "has shape 3 x 2, expected 3 x 4".
template <class A, class B>
std::string compare_shapes(View<const A> got, View<const B> want) {
  if (got.rows == want.rows && got.cols == want.cols) return {};
  if (got.rows * got.cols == 0 && want.rows * want.cols == 0) return {};
  return "has shape " + shown_shape(got.rows, got.cols) + ", expected " + shown_shape(want.rows, want.cols);
}

struct Difference {
  double max_abs = 0;    ///< largest |got - want|; infinity when exactly one of the two is not finite
  double max_want = 0;   ///< largest |want|
  std::int64_t row = 0;  ///< where max_abs is
  std::int32_t col = 0;
  double got = 0, want = 0;  ///< the values there
};

/// Element by element; views of two shapes are a defect of the caller.
template <class A, class B>
Difference difference(View<const A> got, View<const B> want) {
  const std::string shapes = compare_shapes(got, want);
  SEMFIELD_CHECK(shapes.empty(), shapes);
  Difference worst;
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const double a = static_cast<double>(got(r, c));
      const double b = static_cast<double>(want(r, c));
      double gap = std::abs(a - b);
      if (!std::isfinite(a) || !std::isfinite(b)) gap = std::numeric_limits<double>::infinity();
      if (std::isfinite(b)) worst.max_want = std::max(worst.max_want, std::abs(b));
      if (gap > worst.max_abs) {
        worst.max_abs = gap;
        worst.row = r;
        worst.col = c;
        worst.got = a;
        worst.want = b;
      }
    }
  }
  return worst;
}

/// "" when shapes are equal and max |got - want| <= tolerance * max(|want|, floor), else a sentence with the worst
/// element.
template <class A, class B>
std::string compare(View<const A> got, View<const B> want, double tolerance, double floor = 1e-30) {
  if (std::string shapes = compare_shapes(got, want); !shapes.empty()) return shapes;
  const Difference worst = difference(got, want);
  const double allowed = tolerance * std::max(worst.max_want, floor);
  if (worst.max_abs <= allowed) return {};
  return shown_place(worst.row, worst.col) + " is " + shown_number(worst.got) + ", expected " +
         shown_number(worst.want) + " (off by " + shown_number(worst.max_abs) + ", allowed " + shown_number(allowed) +
         ")";
}

/// "" when shapes are equal and the norm of got - want is at most tolerance times the norm of want (roots of sums of
/// squares): for quantities with jumps, where single elements may differ by all they have.
template <class A, class B>
std::string compare_norms(View<const A> got, View<const B> want, double tolerance) {
  if (std::string shapes = compare_shapes(got, want); !shapes.empty()) return shapes;
  double off = 0, all = 0;
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const double b = static_cast<double>(want(r, c)), d = static_cast<double>(got(r, c)) - b;
      off += d * d;
      all += b * b;
    }
  }
  if (std::sqrt(off) <= tolerance * std::sqrt(all)) return {};
  return "differs by " + shown_number(std::sqrt(off)) + " in norm, allowed " + shown_number(tolerance * std::sqrt(all));
}

/// "" when shapes are equal and every element has the same bits, else a sentence with the first element that has not.
template <class A>
std::string compare_bits(View<const A> got, View<const A> want) {
  if (std::string shapes = compare_shapes(got, want); !shapes.empty()) return shapes;
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const A a = got(r, c);
      const A b = want(r, c);
      if (std::memcmp(&a, &b, sizeof(A)) != 0) {
        return shown_place(r, c) + " is " + shown_number(static_cast<double>(a)) + ", expected the same bits as " +
               shown_number(static_cast<double>(b));
      }
    }
  }
  return {};
}

// Analytic gradients against central differences, in double.

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

// A component's tensors for a test: allocated as declared, filled reproducibly, with gradients.

/// Allocates what `component` declares. Values are drawn in fp32 from (seed, tensor name, element), so that a float box
/// and a double box of one component hold the same numbers.
template <class Real>
class TensorBox : NonCopyable {
 public:
  /// Learned tensors start as declared plus uniform noise of +-`noise`, so that zero-initialised layers are exercised
  /// too.
  TensorBox(const Parametric<Real>& component, std::uint64_t seed, double noise = 0.1);

  const Tensors<Real>& tensors() const { return tensors_; }
  /// The same without gradients, as a renderer passes them.
  Tensors<Real> values_only() const { return {value_views_, {}}; }
  const std::vector<TensorSpec>& specs() const { return specs_; }
  std::size_t count() const { return specs_.size(); }
  View<Real> value(std::size_t index) const { return value_views_[index]; }
  View<Real> grad(std::size_t index) const { return grad_views_[index]; }
  /// Trained by the optimiser.
  bool learned(std::size_t index) const { return is_learned(specs_[index].role); }
  void fill_grads(Real value) {
    for (std::vector<Real>& grad : grads_) std::fill(grad.begin(), grad.end(), value);
  }
  /// grad += value of every learned tensor.
  void add_to_grads(Real value) {
    for (std::size_t i = 0; i < grads_.size(); ++i) {
      if (!learned(i)) continue;
      for (Real& element : grads_[i]) element += value;
    }
  }

 private:
  std::vector<TensorSpec> specs_;
  std::vector<std::vector<Real>> values_, grads_;
  std::vector<View<Real>> value_views_, grad_views_;
  Tensors<Real> tensors_;
};

extern template class TensorBox<float>;
extern template class TensorBox<double>;

}  // namespace semfield::testkit
