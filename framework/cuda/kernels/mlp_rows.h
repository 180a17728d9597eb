// What networks do to rows beside products, on the device: the ends of layers, sines, colours.
#pragma once

#include <cstdint>

#include "core/view.h"

namespace semfield::cuda {

/// out = sums + start, then the ReLU and the mask: `out` [M, N]. start: empty, one row for all, or row row_of[m], or
/// row m. out may be `sums`, and `start` may be `out`.
struct LayerEnd {
  View<const float> sums;
  View<const float> start;
  View<const std::int32_t> row_of;
  bool relu = false;
  View<const float> mask;  ///< [M, N] or empty: 0 where it is not positive
  View<float> out;
};
void finish_rows(const LayerEnd& end);

/// value = sin(frequency sums) and, where it is given, slope = frequency cos(frequency sums).
void sine_rows(View<const float> sums, float frequency, View<float> value, View<float> slope);
/// dz = sums times slope.
void times_slope(View<const float> slope, View<const float> sums, View<float> dz);

/// out [M, N] = row ray_of_sample[m] of in [R, N].
void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out);
/// rows = sigmoid(rows).
void sigmoid_rows(View<float> rows);
/// d_logit = d_value value (1 - value).
void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit);

}  // namespace semfield::cuda
