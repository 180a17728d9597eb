// Layers of networks and their gradients over a tile of samples, with activations in the type of the sums or in bf16.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "compute/isa.h"
#include "core/check.h"
#include "core/half.h"
#include "core/view.h"
#include "core/workspace.h"

namespace semfield {

/// A weight [in, out] in bf16 as the kernels of the instruction set in use read it, packed_weight_words(in, out) words.
struct PackedWeight {
  const std::uint32_t* words = nullptr;
  std::int64_t in = 0, out = 0;
};
std::int64_t packed_weight_words(std::int64_t in, std::int64_t out);
/// `weight` rounded to bf16, or its transpose: then in = weight.cols.
PackedWeight pack_weight(View<const float> weight, bool transposed, std::uint32_t* words);

/// What a network computes with when its activations are float, double or Bf16: sums, and a weight as layers read it.
template <class Activation>
struct LayerTypes {
  using Sum = Activation;
  using Weight = View<const Activation>;  // [in, out]
};
template <>
struct LayerTypes<Bf16> {
  using Sum = float;
  using Weight = PackedWeight;
};
template <class Activation>
using SumOf = typename LayerTypes<Activation>::Sum;

/// y = start + x W, then the ReLU and the mask. An element's bits depend on its own row alone, whatever M is. Rows of
/// bf16 lie bf16_stride(cols) numbers apart, with zeros behind the last column, which products read.
template <class Activation>
struct Layer {
  View<const Activation> x;  ///< [M, in]
  typename LayerTypes<Activation>::Weight weight;
  View<const SumOf<Activation>> start{};  ///< empty: zero; [1, out]: one row for all; else row row_of[m], or row m
  View<const std::int32_t> row_of{};      ///< [M, 1] or empty
  bool relu = false;                      ///< NaN stays NaN
  View<const Activation> mask{};          ///< [M, out] or empty: y = mask > 0 ? y : 0, the gradient of a ReLU
  View<Activation> y{};                   ///< [M, out], in bf16 rounded at the end; or
  View<SumOf<Activation>> exact{};        ///< [M, out], which may be `start`
};
void apply(const Layer<float>& layer);
void apply(const Layer<double>& layer);
void apply(const Layer<Bf16>& layer);

/// d_weight [in, out] += x^T dz and d_bias [1, out] += the sums of dz's columns (empty: not wanted); sums over rows in
/// order. x [M, in], dz [M, out].
void weight_gradient(View<const float> x, View<const float> dz, View<float> d_weight, View<float> d_bias);
void weight_gradient(View<const double> x, View<const double> dz, View<double> d_weight, View<double> d_bias);
void weight_gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight, View<float> d_bias);

/// d_ray_term [R, out] = sum of dz [M, out] over each ray's samples, in order; rays without samples get 0.
void per_ray_sum(View<const float> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term);
void per_ray_sum(View<const double> dz, View<const std::int32_t> ray_of_sample, View<double> d_ray_term);
void per_ray_sum(View<const Bf16> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term);

constexpr std::int64_t bf16_stride(std::int64_t cols) { return (cols + 31) / 32 * 32; }

/// Memory of activations [rows, cols], in whole cache lines.
template <class Activation>
constexpr std::size_t activation_bytes(std::int64_t rows, std::int64_t cols) {
  const std::int64_t stride = std::is_same_v<Activation, Bf16> ? bf16_stride(cols) : cols;
  return (static_cast<std::size_t>(rows * stride) * sizeof(Activation) + 63) / 64 * 64;
}
/// Activations in memory of activation_bytes that begins on 64 bytes.
template <class Activation>
View<Activation> activation_rows(std::byte* memory, std::int64_t rows, std::int32_t cols) {
  const std::int64_t stride = std::is_same_v<Activation, Bf16> ? bf16_stride(cols) : cols;
  return View<Activation>(reinterpret_cast<Activation*>(memory), rows, cols, stride);
}
template <class Activation>
View<Activation> take_activations(Workspace& arena, std::int64_t rows, std::int32_t cols) {
  return activation_rows<Activation>(arena.take_bytes(activation_bytes<Activation>(rows, cols)), rows, cols);
}

/// to = from, rounded to nearest, ties to even, with the zeros behind each row; where mask [M, cols] is given and not
/// positive, 0.
void round_rows(View<const float> from, View<Bf16> to, View<const Bf16> mask = {});
View<const Bf16> rounded_rows(View<const float> values, Workspace& arena);
/// The same numbers in fp32.
void widen_rows(View<const Bf16> from, View<float> to);

/// sum [1, H] = sum over k of weight [N, 1] times rows [N, H], in order.
void weighted_row_sum(View<const float> weight, View<const Bf16> rows, View<float> sum);
/// Its gradient through the ReLU that made the rows: d_rows [N, H] = weight times d_sum where a row is positive, else
/// 0, and dots [N, 1] (empty: not wanted) = d_sum . row.
void weighted_row_sum_backward(View<const float> weight, View<const Bf16> rows, View<const float> d_sum,
                               View<float> dots, View<Bf16> d_rows);

/// `values` as a layer's input: themselves, or rounded into `arena`.
template <class Activation>
View<const Activation> as_input(View<const SumOf<Activation>> values, Workspace& arena) {
  if constexpr (std::is_same_v<Activation, Bf16>) {
    return rounded_rows(values, arena);
  } else {
    return values;
  }
}

// The few memory-bound loops around layers (compute/layers.h).

/// dy = y > 0 ? dy : 0, in place: gradient after a ReLU to gradient before it.
template <class Real>
void relu_backward(View<const Real> y, View<Real> dy) {
  SEMFIELD_CHECK(y.rows == dy.rows && y.cols == dy.cols, "shapes of a ReLU do not fit");
  cpu_kernels<Real>().relu_backward(y, dy);
}

/// out [cols, rows] = in^T.
template <class Real>
void transpose(View<const Real> in, View<Real> out);

/// Row-wise copy between strided matrices of one shape.
template <class Real>
void copy_rows(View<const Real> in, View<Real> out) {
  SEMFIELD_CHECK(in.rows == out.rows && in.cols == out.cols, "shapes of a copy do not fit");
  for (std::int64_t r = 0; r < in.rows; ++r) std::copy_n(in.row(r), in.cols, out.row(r));
}
template <class Real>
void fill(View<Real> out, Real value) {
  for (std::int64_t r = 0; r < out.rows; ++r) std::fill_n(out.row(r), out.cols, value);
}

// The kernels of layers in bf16, compiled once per instruction set (compute/isa.h).

struct Bf16Kernels {
  std::int64_t (*packed_words)(std::int64_t in, std::int64_t out);
  void (*pack_weight)(View<const float> weight, bool transposed, std::uint32_t* words);
  void (*layer)(const Layer<Bf16>& layer);
  void (*weight_gradient)(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight);
  void (*add_rows)(View<const Bf16> rows, View<float> sum);  // sum [1, cols] += every row, in order
  void (*round_rows)(View<const float> from, View<Bf16> to, View<const Bf16> mask);
  void (*widen_rows)(View<const Bf16> from, View<float> to);
  void (*weighted_sum)(View<const float> weight, View<const Bf16> rows, View<float> sum);
  void (*weighted_sum_backward)(View<const float> weight, View<const Bf16> rows, View<const float> d_sum,
                                View<float> dots, View<Bf16> d_rows);
};

/// Of the instruction set in use.
const Bf16Kernels& bf16_kernels();

}  // namespace semfield
