// Linear layers over a batch on the device, for activations kept as fp32 or bf16: what fields and the semantic head are
// made of. Twins of compute/layers.h. Everything is queued on launch().stream; products go through cuda/matmul.h.
#pragma once

#include <cuda_bf16.h>

#include <cstdint>

#include "core/view.h"
#include "core/workspace.h"

namespace semfield::cuda {

enum class Activation : std::uint8_t { none, relu };

/// Act: float (products in fp32) or __nv_bfloat16 (operands bf16, sums in fp32). Weights of a product have its type.
/// y = activation(x W + bias), or with `add` activation(y + x W + bias); x [M, in], weight [in, out] (row stride as
/// given), bias [1, out] fp32 or empty, y [M, out] of Act or float.
template <class Act, class Out>
struct LinearForward {
  View<const Act> x, weight;
  View<const float> bias;
  View<Out> y;
  Activation activation = Activation::none;
  bool add = false;
  /// The same bias as Out. cuBLASLt adds a bias of the output's type alone: without it, bf16 outputs cost a further
  /// pass.
  View<const Out> rounded_bias;
  /// With relu, if not null: [M] rows of mask_stride_bits(out) bits, y > 0, for LinearBackward.
  std::uint32_t* mask = nullptr;
};
template <class Act, class Out>
void linear_forward(const LinearForward<Act, Out>& call);

/// From dz [M, out] = dL/d(x W + b): d_weight [in, out] fp32 +=, d_bias [1, out] fp32 +=, dx [M, in] = dz W^T (or +=
/// with add_to_dx), with relu_input masked by x > 0. weight [in, out], not transposed: a product reads either way. x,
/// dz and weight may have more columns (rows) than d_weight: padding. Empty views are not computed. Sums have a fixed
/// order.
template <class Act, class Dx>
struct LinearBackward {
  View<const Act> x, dz, weight;
  View<float> d_weight, d_bias;
  View<Dx> dx;
  bool add_to_dx = false;
  bool relu_input = false;
  /// x > 0 as bits, if forward wrote them: an eighth of x's bytes to read.
  std::uint32_t* mask = nullptr;
  /// [1, in] += column sums of dx with relu_input: the bias gradient of the layer that made x, in the same pass.
  View<float> dx_sums;
};
template <class Act, class Dx>
void linear_backward(const LinearBackward<Act, Dx>& call, Workspace& arena);

/// out = in, with conversion; as many rows, strides as given. Columns of `out` beyond in.cols are set to 0 when out is
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
template <class Act, class Grad>
void relu_backward(View<const Act> y, View<Grad> dy);
template <class Act>
void relu_backward(View<const Act> y, View<Act> dy) {
  relu_backward<Act, Act>(y, dy);
}
/// y = activation(y + bias), mask as in LinearForward: the pass behind a product that cuBLASLt cannot finish itself.
/// bias [1, out] or empty.
template <class Act>
void finish_layer(View<const float> bias, Activation activation, View<Act> y, std::uint32_t* mask);
/// sums [1, cols] += column sums of dz, rows in an order that depends on their number alone.
template <class Act>
void add_column_sums(View<const Act> dz, View<float> sums, Workspace& arena);
/// dx = x > 0 ? dx : 0 by mask (LinearForward::mask), and sums [1, dx.cols] += its column sums; dx.cols a multiple of
/// 8, rows of dx on 16-byte boundaries.
void mask_and_sum(const std::uint32_t* mask, View<__nv_bfloat16> dx, View<float> sums, Workspace& arena);
/// sums [1, cols] += sums over the rows of partial [any, cols], in a fixed order.
void add_partials(View<const float> partial, View<float> sums);
/// y [M, out] = share [M, 1] bias [1, out].
void shared_bias_forward(View<const float> share, View<const float> bias, View<float> y);
/// From dy [M, out]: d_share [M, 1] = dy bias^T, d_bias [1, out] += share^T dy. Sums have a fixed order.
struct SharedBiasBackward {
  View<const float> share, bias, dy;
  View<float> d_share, d_bias;
};
void shared_bias_backward(const SharedBiasBackward& call, Workspace& arena);
/// d_ray_term [R, out] = sum of dz over each ray's samples, rays in order; ray_of_sample ascending. Rows that are not
/// in use are not added. dz may have more columns: padding.
template <class Act>
void per_ray_backward(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term);

// What networks do to rows beside products, on the device: the ends of layers, sines, colours.

/// out = sums + start, then the ReLU and the mask: `out` [M, N]. start: empty, one row for all, or row row_of[m], or
/// row m. out may be `sums`, and `start` may be `out`. Act: float or __nv_bfloat16; Sums: that or float.
template <class Sums, class Act>
struct LayerEnd {
  View<const Sums> sums;
  View<const float> start;
  View<const std::int32_t> row_of;
  bool relu = false;
  View<const Act> mask;  ///< [M, N] or empty: 0 where it is not positive
  View<Act> out;
};
template <class Sums, class Act>
void finish_rows(const LayerEnd<Sums, Act>& end);

/// value = sin(frequency sums) and, where it is given, slope = frequency cos(frequency sums).
template <class Act>
void sine_rows(View<const float> sums, float frequency, View<Act> value, View<Act> slope);
/// dz = sums times slope.
template <class Act>
void times_slope(View<const Act> slope, View<const float> sums, View<Act> dz);

/// out [M, N] = row ray_of_sample[m] of in [R, N].
void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out);
/// rows = sigmoid(rows).
void sigmoid_rows(View<float> rows);
/// d_logit = d_value value (1 - value).
void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit);

}  // namespace semfield::cuda
