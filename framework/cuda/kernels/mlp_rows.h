// What networks do to rows beside products, on the device: rounded weights, the ends of layers, sines, colours.
#pragma once

#include <cuda_bf16.h>

#include <cstdint>

#include "core/view.h"

namespace semfield::cuda {

/// Columns of an activation in memory: bf16 rows are padded with zeros to whole vectors of 16 bytes, which keeps every
/// product aligned.
template <class Act>
constexpr std::int32_t padded_cols(std::int32_t cols) {
  return sizeof(Act) == sizeof(float) ? cols : (cols + 7) / 8 * 8;
}

/// to [padded_rows, padded_cols] = from [rows, cols] in bf16, zeros around it.
struct Rounding {
  const float* from = nullptr;
  __nv_bfloat16* to = nullptr;
  std::int32_t rows = 0, cols = 0, stride = 0, padded_rows = 0, padded_cols = 0;
};
inline constexpr int kMostRoundings = 96;
struct Roundings {
  Rounding all[kMostRoundings];
  int count = 0;
};
/// All in one launch.
void round_matrices(const Roundings& roundings);

/// out = sums + start, then the ReLU and the mask: `out` [M, N], of which the columns behind sums.cols become 0. start:
/// empty, one row for all, or row row_of[m], or row m. out may be `sums`, and `start` may be `out`.
template <class Act, class Out>
struct LayerEnd {
  View<const float> sums;
  View<const float> start;
  View<const std::int32_t> row_of;
  bool relu = false;
  View<const Act> mask;  ///< [M, N] or empty: 0 where it is not positive
  View<Out> out;
};
template <class Act, class Out>
void finish_rows(const LayerEnd<Act, Out>& end);

/// value = sin(frequency sums) and, where it is given, slope = frequency cos(frequency sums); 0 behind sums.cols.
template <class Act>
void sine_rows(View<const float> sums, float frequency, View<Act> value, View<Act> slope);
/// dz = sums times slope; 0 behind sums.cols.
template <class Act>
void times_slope(View<const Act> slope, View<const float> sums, View<Act> dz);

/// out [M, N] = row ray_of_sample[m] of in [R, N].
void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out);
/// rows = sigmoid(rows).
void sigmoid_rows(View<float> rows);
/// d_logit = d_value value (1 - value).
void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit);

}  // namespace semfield::cuda
