// Linear layers over a batch on the device, for activations kept as fp32 or bf16: what fields and the semantic head are
// made of. Twins of core/linear.h. Everything is queued on launch().stream; products go through cuBLASLt.
#pragma once

#include <cuda_bf16.h>

#include "core/linear.h"
#include "core/view.h"
#include "core/workspace.h"

namespace semfield::cuda {

/// Act: float (products in fp32) or __nv_bfloat16 (operands bf16, sums in fp32). Weights of a product have its type.
/// y = activation(x W + bias), or with `add` activation(y + x W); x [M, in], weight [in, out] (row stride as given),
/// bias [1, out] fp32 or empty, y [M, out] of Act or float.
template <class Act, class Out>
struct LinearForward {
  View<const Act> x, weight;
  View<const float> bias;
  View<Out> y;
  Activation activation = Activation::none;
  bool add = false;
};
template <class Act, class Out>
void linear_forward(const LinearForward<Act, Out>& call);

/// y[m] = activation(x[m] W + ray_term[ray_of_sample[m]]); ray_term [R, out] fp32.
template <class Act>
void linear_forward_per_ray(View<const Act> x, View<const Act> weight, View<const float> ray_term,
                            View<const std::int32_t> ray_of_sample, Activation activation, View<Act> y);

/// From dz [M, out] = dL/d(x W + b): d_weight [in, out] fp32 +=, d_bias [1, out] fp32 +=, dx [M, in] = dz W^T (or +=
/// with add_to_dx), with relu_input masked by x > 0. weight [in, out], not transposed: cuBLASLt reads either way. Empty
/// views are not computed. With launch().deterministic, or always, sums have a fixed order.
template <class Act, class Dx>
struct LinearBackward {
  View<const Act> x, dz, weight;
  View<float> d_weight, d_bias;
  View<Dx> dx;
  bool add_to_dx = false;
  bool relu_input = false;
};
template <class Act, class Dx>
void linear_backward(const LinearBackward<Act, Dx>& call, Workspace& arena);

/// out = in, with conversion; shapes equal, strides as given. Columns of `out` beyond in.cols are set to 0 when out is
/// wider.
template <class From, class To>
void convert(View<const From> in, View<To> out);
/// out [cols, rows] = in^T.
void transpose(View<const float> in, View<float> out);
void fill(View<float> out, float value);
/// out += in.
template <class From, class To>
void add_rows(View<const From> in, View<To> out);
/// dz = y > 0 ? dy : 0.
template <class Act>
void relu_backward(View<const Act> y, View<Act> dy);
/// d_ray_term [R, out] = sum of dz over each ray's samples, rays in order; ray_of_sample ascending.
template <class Act>
void per_ray_backward(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term);
/// rgb = 1 / (1 + e^-z) in place; dz = d_rgb rgb (1 - rgb).
void sigmoid(View<float> rgb);
template <class Act>
void sigmoid_backward(View<const float> rgb, View<const float> d_rgb, View<Act> dz);

}  // namespace semfield::cuda
