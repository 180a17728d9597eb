// Linear layers as calls of the matrix product, and the few memory-bound loops around them.
#include "compute/linear.h"

#include <algorithm>

#include "compute/cpu_kernels.h"
#include "core/check.h"

namespace semfield {

namespace {

template <class Real>
Gemm<Real> product(View<const Real> x, View<const Real> weight, Activation activation, View<Real> y,
                   Precision precision) {
  SEMFIELD_CHECK(x.cols == weight.rows && x.rows == y.rows && weight.cols == y.cols,
                 "shapes of a linear layer do not fit");
  return {.m = x.rows,
          .n = weight.cols,
          .k = x.cols,
          .a = x.data,
          .a_row = x.row_stride,
          .b = weight.data,
          .b_row = weight.row_stride,
          .c = y.data,
          .c_row = y.row_stride,
          .relu = activation == Activation::relu,
          .precision = precision};
}

}  // namespace

template <class Real>
void linear_forward(View<const Real> x, View<const Real> weight, View<const Real> bias, Activation activation,
                    View<Real> y, Precision precision) {
  SEMFIELD_CHECK(bias.empty() || bias.cols == y.cols, "bias of a linear layer has another width");
  Gemm<Real> g = product(x, weight, activation, y, precision);
  g.bias = bias.data;
  gemm(g);
}

template <class Real>
void linear_forward_add(View<const Real> x, View<const Real> weight, Activation activation, View<Real> y,
                        Precision precision) {
  Gemm<Real> g = product(x, weight, activation, y, precision);
  g.accumulate = true;
  gemm(g);
}

template <class Real>
void linear_forward_per_ray(View<const Real> x, View<const Real> weight, View<const Real> ray_term,
                            View<const std::int32_t> ray_of_sample, Activation activation, View<Real> y,
                            Precision precision) {
  SEMFIELD_CHECK(ray_term.cols == y.cols && ray_of_sample.rows == y.rows, "ray term of a linear layer does not fit");
  Gemm<Real> g = product(x, weight, activation, y, precision);
  g.row_term = ray_term.data;
  g.row_term_stride = ray_term.row_stride;
  g.row_of = ray_of_sample.data;
  g.row_of_stride = ray_of_sample.row_stride;
  gemm(g);
}

template <class Real>
void relu_backward(View<const Real> y, View<Real> dy) {
  SEMFIELD_CHECK(y.rows == dy.rows && y.cols == dy.cols, "shapes of a ReLU do not fit");
  cpu_kernels<Real>().relu_backward(y, dy);
}

template <class Real>
void bias_backward(View<const Real> dz, View<Real> d_bias) {
  SEMFIELD_CHECK(d_bias.cols == dz.cols, "bias gradient has another width");
  cpu_kernels<Real>().bias_backward(dz, d_bias);
}

template <class Real>
void per_ray_backward(View<const Real> dz, View<const std::int32_t> ray_of_sample, View<Real> d_ray_term) {
  SEMFIELD_CHECK(d_ray_term.cols == dz.cols && ray_of_sample.rows == dz.rows, "ray gradient does not fit");
  cpu_kernels<Real>().per_ray_backward(dz, ray_of_sample, d_ray_term);
}

template <class Real>
void linear_backward(View<const Real> x, View<const Real> dz, const LinearGrad<Real>& grad) {
  if (!grad.d_weight.empty()) gemm_at_b_add(x, dz, grad.d_weight, grad.precision);
  if (!grad.d_bias.empty()) bias_backward(dz, grad.d_bias);
  if (!grad.dx.empty()) {
    gemm(dz, grad.weight_t, grad.dx, grad.add_to_dx, grad.precision, grad.relu_input ? x : View<const Real>());
  }
}

template <class Real>
void linear_backward(Activation activation, View<const Real> x, View<const Real> y, View<Real> dy,
                     const LinearGrad<Real>& grad) {
  if (activation == Activation::relu) relu_backward(y, dy);
  linear_backward(x, View<const Real>(dy), grad);
}

template <class Real>
void transpose(View<const Real> in, View<Real> out) {
  SEMFIELD_CHECK(in.rows == out.cols && in.cols == out.rows, "shapes of a transpose do not fit");
  constexpr std::int32_t kBlock = 16;  // a block's rows stay in cache while its columns are written
  for (std::int64_t r0 = 0; r0 < in.rows; r0 += kBlock) {
    const std::int64_t r1 = std::min<std::int64_t>(in.rows, r0 + kBlock);
    for (std::int32_t c = 0; c < in.cols; ++c) {
      for (std::int64_t r = r0; r < r1; ++r) out(c, static_cast<std::int32_t>(r)) = in(r, c);
    }
  }
}

template <class Real>
void copy_rows(View<const Real> in, View<Real> out) {
  SEMFIELD_CHECK(in.rows == out.rows && in.cols == out.cols, "shapes of a copy do not fit");
  for (std::int64_t r = 0; r < in.rows; ++r) std::copy_n(in.row(r), in.cols, out.row(r));
}

template <class Real>
void fill(View<Real> out, Real value) {
  for (std::int64_t r = 0; r < out.rows; ++r) std::fill_n(out.row(r), out.cols, value);
}

SEMFIELD_LINEAR_OF(, float)
SEMFIELD_LINEAR_OF(, double)

}  // namespace semfield
