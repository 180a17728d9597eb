// Linear layers and their gradients over a tile of samples.
#pragma once

#include <cstdint>

#include "compute/gemm.h"
#include "core/view.h"

namespace semfield {

enum class Activation : std::uint8_t { none, relu };

/// y = activation(x W + bias). x [M, in], weight [in, out], bias [1, out] (empty: none), y [M, out].
template <class Real>
void linear_forward(View<const Real> x, View<const Real> weight, View<const Real> bias, Activation activation,
                    View<Real> y, Precision precision = Precision::fp32);

/// y = activation(y + x W): a further part of a concatenated input.
template <class Real>
void linear_forward_add(View<const Real> x, View<const Real> weight, Activation activation, View<Real> y,
                        Precision precision = Precision::fp32);

/// y[m] = activation(x[m] W + ray_term[ray_of_sample[m]]): what is constant along a ray is added as one row a ray.
/// ray_term [R, out] (with the bias in it), ray_of_sample [M, 1].
template <class Real>
void linear_forward_per_ray(View<const Real> x, View<const Real> weight, View<const Real> ray_term,
                            View<const std::int32_t> ray_of_sample, Activation activation, View<Real> y,
                            Precision precision = Precision::fp32);

/// dy = y > 0 ? dy : 0, in place: gradient after a ReLU to gradient before it.
template <class Real>
void relu_backward(View<const Real> y, View<Real> dy);

/// d_bias [1, out] += column sums of dz [M, out], rows in order.
template <class Real>
void bias_backward(View<const Real> dz, View<Real> d_bias);

/// d_ray_term [R, out] = sum of dz [M, out] over each ray's samples, in order; rays without samples get 0.
template <class Real>
void per_ray_backward(View<const Real> dz, View<const std::int32_t> ray_of_sample, View<Real> d_ray_term);

/// Gradients of a layer from dz = dL/d(x W + bias) [M, out]: d_weight [in, out] +=, d_bias [1, out] +=, dx [M, in] =
/// (or += with add_to_dx). weight_t [out, in] is the stored transpose. An empty view is not computed.
template <class Real>
struct LinearGrad {
  View<const Real> weight_t;
  View<Real> d_weight, d_bias, dx;
  bool add_to_dx = false;
  Precision precision = Precision::fp32;
  bool relu_input = false;  ///< x is the result of a ReLU: dx becomes the gradient before it, dx = x > 0 ? dx : 0
};
template <class Real>
LinearGrad<Real> after_relu(LinearGrad<Real> grad) {
  grad.relu_input = true;
  return grad;
}
template <class Real>
void linear_backward(View<const Real> x, View<const Real> dz, const LinearGrad<Real>& grad);

/// The same from dy = dL/dy of y = activation(x W + bias); with relu, dy is turned into dz in place, the mask read from
/// y.
template <class Real>
void linear_backward(Activation activation, View<const Real> x, View<const Real> y, View<Real> dy,
                     const LinearGrad<Real>& grad);

/// out [cols, rows] = in^T.
template <class Real>
void transpose(View<const Real> in, View<Real> out);

/// Row-wise copy between strided matrices of one shape.
template <class Real>
void copy_rows(View<const Real> in, View<Real> out);
template <class Real>
void fill(View<Real> out, Real value);

#define SEMFIELD_LINEAR_OF(prefix, Real)                                                                          \
  prefix template void linear_forward<Real>(View<const Real>, View<const Real>, View<const Real>, Activation,     \
                                            View<Real>, Precision);                                               \
  prefix template void linear_forward_add<Real>(View<const Real>, View<const Real>, Activation, View<Real>,       \
                                                Precision);                                                       \
  prefix template void linear_forward_per_ray<Real>(View<const Real>, View<const Real>, View<const Real>,         \
                                                    View<const std::int32_t>, Activation, View<Real>, Precision); \
  prefix template void relu_backward<Real>(View<const Real>, View<Real>);                                         \
  prefix template void bias_backward<Real>(View<const Real>, View<Real>);                                         \
  prefix template void per_ray_backward<Real>(View<const Real>, View<const std::int32_t>, View<Real>);            \
  prefix template void linear_backward<Real>(View<const Real>, View<const Real>, const LinearGrad<Real>&);        \
  prefix template void linear_backward<Real>(Activation, View<const Real>, View<const Real>, View<Real>,          \
                                             const LinearGrad<Real>&);                                            \
  prefix template void transpose<Real>(View<const Real>, View<Real>);                                             \
  prefix template void copy_rows<Real>(View<const Real>, View<Real>);                                             \
  prefix template void fill<Real>(View<Real>, Real);

SEMFIELD_LINEAR_OF(extern, float)
SEMFIELD_LINEAR_OF(extern, double)

}  // namespace semfield
