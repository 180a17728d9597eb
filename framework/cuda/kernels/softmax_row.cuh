// Softmax of one row by a warp: lane j holds classes j, j + 32, ...
#pragma once

#include <climits>

#include "cuda/kernels/device_code.cuh"

namespace semfield::cuda {

/// The largest value of a row and where it stands first; every lane gets them.
struct RowTop {
  float largest;
  std::int32_t argmax;
  bool finite;  ///< all values of the row are
};

__device__ inline RowTop top_of_row(const float* row, std::int32_t cols, int lane) {
  RowTop top{-INFINITY, INT_MAX, true};
  for (std::int32_t c = lane; c < cols; c += kWarp) {
    const float value = row[c];
    top.finite = top.finite && isfinite(value);
    if (value > top.largest) top = {value, c, top.finite};
  }
  for (int offset = kWarp / 2; offset > 0; offset /= 2) {
    const float largest = __shfl_xor_sync(kFullMask, top.largest, offset);
    const std::int32_t argmax = __shfl_xor_sync(kFullMask, top.argmax, offset);
    if (largest > top.largest || (largest == top.largest && argmax < top.argmax)) {
      top.largest = largest;
      top.argmax = argmax;
    }
  }
  top.finite = __all_sync(kFullMask, top.finite) != 0;
  if (top.argmax == INT_MAX) top.argmax = 0;  // nothing above -inf: not finite, or no column
  return top;
}

/// e^(s_c - largest) in Real.
template <class Real>
__device__ inline Real exp_below(const float* row, std::int32_t c, float largest) {
  return exp(static_cast<Real>(row[c]) - static_cast<Real>(largest));
}

/// Sum of e^(s_c - largest) over all classes but the largest's, in float64 in a fixed tree; every lane gets it. Keeping
/// that one apart leaves log1p(rest) and -rest / (1 + rest) exact for a row that is almost certain.
template <class Real>
__device__ inline double rest_of_row(const float* row, std::int32_t cols, const RowTop& top, int lane) {
  double rest = 0;
  for (std::int32_t c = lane; c < cols; c += kWarp) {
    if (c != top.argmax) rest += static_cast<double>(exp_below<Real>(row, c, top.largest));
  }
  return warp_sum(rest);
}

}  // namespace semfield::cuda
