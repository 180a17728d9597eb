// What networks do to rows beside products, on the device: the ends of layers, sines, colours.
#pragma once

#include <cuda_bf16.h>

#include <cstdint>

#include "core/view.h"

namespace semfield::cuda {

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
