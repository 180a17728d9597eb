// Layers in bf16 for one instruction set.
#include "compute/bf16/tiles.h"

namespace semfield::SEMFIELD_ISA {

void fill_bf16_kernels(Bf16Kernels& kernels);

namespace {

#if defined(SEMFIELD_TILES)
namespace products {
using tiles::pack_weight;
using tiles::packed_words;
void layer(const Layer<Bf16>& l) { tiles::layer<SEMFIELD_TILES>(l); }
void weight_gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight) {
  tiles::weight_gradient<SEMFIELD_TILES>(x, dz, d_weight);
}
}  // namespace products
#else
namespace products = dots;
#endif

void pack(View<const float> weight, bool transposed, std::uint32_t* words) {
  if (transposed) {
    products::pack_weight(
        weight.cols, weight.rows, [&](std::int64_t k, std::int64_t n) { return weight.row(n)[k]; }, words);
  } else {
    products::pack_weight(
        weight.rows, weight.cols, [&](std::int64_t k, std::int64_t n) { return weight.row(k)[n]; }, words);
  }
}

constexpr std::int32_t kWidth = 64;  // columns whose sums stay in registers while the rows pass by

/// d_weight += x^T dz where dz has so few columns that they would leave most of a vector empty: vectors along x.
template <int kCols>
void narrow_gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight) {
  for (std::int32_t first = 0; first < x.cols; first += kWidth) {
    const std::int32_t width = std::min(kWidth, x.cols - first);
    float sum[kCols][kWidth] = {}, values[kWidth] = {};
    for (std::int32_t i = 0; i < width; ++i) {
      for (int j = 0; j < kCols; ++j) sum[j][i] = d_weight(first + i, j);
    }
    for (std::int64_t m = 0; m < x.rows; ++m) {
      const Bf16* row = x.row(m) + first;
      const std::int32_t there = std::min<std::int32_t>(kWidth, (width + 31) / 32 * 32);  // zeros behind the last
      if (there == kWidth) {
        for (std::int32_t i = 0; i < kWidth; ++i) values[i] = widen(row[i]);
      } else {
        for (std::int32_t i = 0; i < there; ++i) values[i] = widen(row[i]);
      }
      for (int j = 0; j < kCols; ++j) {
        const float factor = widen(dz.row(m)[j]);
        for (std::int32_t i = 0; i < kWidth; ++i) sum[j][i] += values[i] * factor;
      }
    }
    for (std::int32_t i = 0; i < width; ++i) {
      for (int j = 0; j < kCols; ++j) d_weight(first + i, j) = sum[j][i];
    }
  }
}

void gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight) {
  switch (dz.cols) {
    case 1:
      return narrow_gradient<1>(x, dz, d_weight);
    case 2:
      return narrow_gradient<2>(x, dz, d_weight);
    case 3:
      return narrow_gradient<3>(x, dz, d_weight);
    case 4:
      return narrow_gradient<4>(x, dz, d_weight);
    default:
      products::weight_gradient(x, dz, d_weight);
  }
}

void add_rows(View<const Bf16> rows, View<float> total) {
  for (std::int32_t first = 0; first < rows.cols; first += kWidth) {
    const std::int32_t width = std::min(kWidth, rows.cols - first);
    float sum[kWidth] = {};
    std::copy_n(total.data + first, width, sum);
    if (width == kWidth) {
      for (std::int64_t m = 0; m < rows.rows; ++m) {
        const Bf16* row = rows.row(m) + first;
        for (std::int32_t i = 0; i < kWidth; ++i) sum[i] += widen(row[i]);
      }
    } else {
      for (std::int64_t m = 0; m < rows.rows; ++m) {
        const Bf16* row = rows.row(m) + first;
        for (std::int32_t i = 0; i < width; ++i) sum[i] += widen(row[i]);
      }
    }
    std::copy_n(sum, width, total.data + first);
  }
}

void round_all(View<const float> from, View<Bf16> to, View<const Bf16> mask) {
  for (std::int64_t m = 0; m < from.rows; ++m) {
    const float* in = from.row(m);
    const Bf16* keep = mask.empty() ? nullptr : mask.row(m);
    for (std::int64_t j = 0; j < from.cols; j += 32) {
      finish_row({false, keep == nullptr ? nullptr : keep + j, to.row(m) + j, nullptr}, in + j, in + j + 16,
                 std::min<std::int64_t>(from.cols - j, 32));
    }
  }
}

void widen_all(View<const Bf16> from, View<float> to) {
  for (std::int64_t m = 0; m < from.rows; ++m) {
    const Bf16* in = from.row(m);
    float* out = to.row(m);
    for (std::int32_t j = 0; j < from.cols; ++j) out[j] = widen(in[j]);
  }
}

void weighted_sum(View<const float> weight, View<const Bf16> rows, View<float> total) {
  for (std::int32_t first = 0; first < rows.cols; first += kWidth) {
    const std::int32_t width = std::min(kWidth, rows.cols - first);
    float sum[kWidth] = {};
    for (std::int64_t k = 0; k < rows.rows; ++k) {
      const float w = *weight.row(k);
      if (w == 0) continue;
      const Bf16* row = rows.row(k) + first;
      if (width == kWidth) {
        for (std::int32_t i = 0; i < kWidth; ++i) sum[i] += w * widen(row[i]);
      } else {
        for (std::int32_t i = 0; i < width; ++i) sum[i] += w * widen(row[i]);
      }
    }
    std::copy_n(sum, width, total.data + first);
  }
}

void weighted_sum_backward(View<const float> weight, View<const Bf16> rows, View<const float> d_sum, View<float> dots,
                           View<Bf16> d_rows) {
  constexpr std::int32_t kLanes = 32;
  for (std::int64_t k = 0; k < rows.rows; ++k) {
    const float w = *weight.row(k);
    float lanes[kLanes] = {}, gradient[kLanes];
    for (std::int32_t first = 0; first < rows.cols; first += kLanes) {
      const std::int32_t count = std::min(kLanes, rows.cols - first);
      const Bf16* row = rows.row(k) + first;
      const float* d = d_sum.data + first;
      if (count == kLanes) {
        for (std::int32_t i = 0; i < kLanes; ++i) lanes[i] += widen(row[i]) * d[i];
        for (std::int32_t i = 0; i < kLanes; ++i) gradient[i] = w * d[i];
      } else {
        for (std::int32_t i = 0; i < count; ++i) lanes[i] += widen(row[i]) * d[i];
        for (std::int32_t i = 0; i < count; ++i) gradient[i] = w * d[i];
      }
      finish_row({false, row, d_rows.row(k) + first, nullptr}, gradient, gradient + 16, count);
    }
    if (dots.empty()) continue;
    for (std::int32_t half = kLanes / 2; half > 0; half /= 2) {
      for (std::int32_t i = 0; i < half; ++i) lanes[i] += lanes[i + half];
    }
    *dots.row(k) = lanes[0];
  }
}

}  // namespace

void fill_bf16_kernels(Bf16Kernels& kernels) {
  kernels = {products::packed_words, pack, products::layer, gradient, add_rows, round_all, widen_all, weighted_sum,
             weighted_sum_backward};
}

}  // namespace semfield::SEMFIELD_ISA
