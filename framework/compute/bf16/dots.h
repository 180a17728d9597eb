// Layers in bf16 with the dot products of AVX-512, or written in fp32 where the CPU has none. For kernel files
// alone: everything here is private to the file and to its instruction set.
#pragma once

#include "compute/bf16/numbers.h"
#include "compute/gemm_tiles.h"

namespace semfield::SEMFIELD_ISA {
namespace dots {
namespace {

constexpr std::int64_t kPanel = 64, kRows = 48;  // of C that are made at once

inline void finish_rows(const Layer<Bf16>& l, std::int64_t row, std::int64_t end, std::int64_t first, std::int64_t cols,
                        const float* sums) {
  for (; row < end; ++row, sums += kPanel) {
    for (std::int64_t j = 0; j < cols; j += 32)
      finish_row(row_end(l, row, first + j), sums + j, sums + j + 16, std::min<std::int64_t>(cols - j, 32));
  }
}

#if defined(__AVX512BF16__)

inline std::int64_t pairs_of(std::int64_t in) { return (in + 1) / 2; }
inline std::int64_t panel_width(std::int64_t cols) { return (cols + 15) / 16 * 16; }

// Packed weights: panels of up to 64 columns, each with its pairs of rows without gaps.
inline std::int64_t packed_words(std::int64_t in, std::int64_t out) { return pairs_of(in) * panel_width(out); }

template <class Value>
void pack_weight(std::int64_t in, std::int64_t out, const Value& value, std::uint32_t* words) {
  for (std::int64_t first = 0; first < out; first += kPanel) {
    const std::int64_t cols = std::min(kPanel, out - first);
    for (std::int64_t k = 0; k < in; k += 2) {
      for (std::int64_t j = 0; j < panel_width(cols); ++j) {
        const std::uint32_t low = j < cols ? rounded(value(k, first + j)).bits : 0u;
        const std::uint32_t high = j < cols && k + 1 < in ? rounded(value(k + 1, first + j)).bits : 0u;
        *words++ = low | high << 16;
      }
    }
  }
}

inline void layer(const Layer<Bf16>& l) {
  alignas(64) float sums[kRows * kPanel];
  const std::int64_t pairs = pairs_of(l.weight.in);
  for (std::int64_t row = 0; row < l.x.rows; row += kRows) {
    const std::int64_t end = std::min(row + kRows, l.x.rows);
    for (std::int64_t first = 0; first < l.weight.out; first += kPanel) {
      const std::int64_t cols = std::min(kPanel, l.weight.out - first);
      const Cover<PairDot> shape = cover_of<PairDot>(static_cast<int>(cols), false);
      TileArgs<PairDot> t{};
      t.a_step = l.x.row_stride / 2;
      t.b = l.weight.words + first * pairs;
      t.b_row = panel_width(cols);
      t.c_row = kPanel;
      t.k = pairs;
      t.cols = static_cast<int>(cols);
      for (std::int64_t at = row; at < end;) {
        const TileChoice choice = choose_rows(end - at, shape.rows);
        t.a = reinterpret_cast<const std::uint32_t*>(l.x.row(at));
        t.c = sums + (at - row) * kPanel;
        for (int i = 0; i < choice.rows; ++i) {
          const float* start = start_of(l, at + i);
          t.start[i] = start == nullptr ? nullptr : start + first;
        }
        shape.tiles[choice.index](t);
        at += choice.rows;
      }
      finish_rows(l, row, end, first, cols, sums);
    }
  }
}

/// Rows [row, row + count) in pairs, `padded` columns from `col` on; word i of pair p = (in[2p][i], in[2p + 1][i]),
/// zeros beyond the last column and row.
inline void pair_rows(View<const Bf16> in, std::int64_t row, std::int64_t count, std::int64_t col, std::int64_t padded,
                      std::uint32_t* out) {
  for (std::int64_t p = 0; 2 * p < count; ++p) {
    const Bf16 *even = in.row(row + 2 * p) + col, *odd = 2 * p + 1 < count ? even + in.row_stride : nullptr;
    for (std::int64_t i = 0; i < padded; i += 16) {
      const std::int64_t left = std::clamp<std::int64_t>(in.cols - col - i, 0, 16);
      const auto lanes = static_cast<__mmask16>((1u << left) - 1);
      const __m256i low = _mm256_maskz_loadu_epi16(lanes, even + i);
      const __m256i high = odd == nullptr ? _mm256_setzero_si256() : _mm256_maskz_loadu_epi16(lanes, odd + i);
      _mm512_storeu_si512(out + p * padded + i, interleaved(low, high));
    }
  }
}

inline void weight_gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight) {
  constexpr std::int64_t kDepth = 256, kPanels = 4;
  alignas(64) std::uint32_t b[kDepth / 2 * kPanel * kPanels], a[kDepth / 2 * kRows];
  for (std::int64_t k = 0; k < x.rows; k += kDepth) {
    const std::int64_t depth = std::min(kDepth, x.rows - k);
    for (std::int64_t col = 0; col < dz.cols; col += kPanel * kPanels) {
      const std::int64_t end = std::min<std::int64_t>(dz.cols, col + kPanel * kPanels);
      for (std::int64_t first = col; first < end; first += kPanel)
        pair_rows(dz, k, depth, first, panel_width(std::min(kPanel, end - first)), b + (first - col) * (kDepth / 2));
      for (std::int64_t row = 0; row < x.cols; row += kRows) {
        pair_rows(x, k, depth, row, kRows, a);
        for (std::int64_t first = col; first < end; first += kPanel) {
          const std::int64_t cols = std::min(kPanel, end - first);
          const Cover<PairDot> shape = cover_of<PairDot>(static_cast<int>(cols), true);
          TileArgs<PairDot> t{};
          t.a_step = kRows;
          t.b = b + (first - col) * (kDepth / 2);
          t.b_row = panel_width(cols);
          t.c_row = d_weight.row_stride;
          t.k = (depth + 1) / 2;
          t.cols = static_cast<int>(cols);
          for (std::int64_t at = row; at < std::min<std::int64_t>(row + kRows, x.cols);) {
            const TileChoice choice = choose_rows(std::min<std::int64_t>(row + kRows, x.cols) - at, shape.rows);
            t.a = a + (at - row);
            t.c = d_weight.row(at) + first;
            for (int i = 0; i < choice.rows; ++i) t.start[i] = t.c + i * t.c_row;
            shape.tiles[choice.index](t);
            at += choice.rows;
          }
        }
      }
    }
  }
}

#else

// Without such instructions the numbers are widened and multiplied in fp32: for the same results within the tolerance
// of the precision, on any CPU.
inline std::int64_t packed_words(std::int64_t in, std::int64_t out) { return in * out; }

template <class Value>
void pack_weight(std::int64_t in, std::int64_t out, const Value& value, std::uint32_t* words) {
  for (std::int64_t k = 0; k < in; ++k) {
    for (std::int64_t j = 0; j < out; ++j) {
      const float wide = widen(rounded(value(k, j)));
      std::memcpy(words + k * out + j, &wide, sizeof wide);
    }
  }
}

inline void layer(const Layer<Bf16>& l) {
  float sums[kPanel], weight[kPanel];
  for (std::int64_t row = 0; row < l.x.rows; ++row) {
    const float* start = start_of(l, row);
    for (std::int64_t first = 0; first < l.weight.out; first += kPanel) {
      const std::int64_t cols = std::min(kPanel, l.weight.out - first);
      std::fill_n(sums, kPanel, 0.0F);
      if (start != nullptr) std::copy_n(start + first, cols, sums);
      for (std::int64_t k = 0; k < l.weight.in; ++k) {
        std::memcpy(weight, l.weight.words + k * l.weight.out + first, static_cast<std::size_t>(cols) * sizeof(float));
        const float value = widen(l.x.row(row)[k]);
        for (std::int64_t j = 0; j < cols; ++j) sums[j] += value * weight[j];
      }
      finish_rows(l, row, row + 1, first, cols, sums);
    }
  }
}

inline void weight_gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight) {
  for (std::int64_t m = 0; m < x.rows; ++m) {
    for (std::int32_t i = 0; i < x.cols; ++i) {
      const float value = widen(x(m, i));
      float* sum = d_weight.row(i);
      for (std::int32_t j = 0; j < dz.cols; ++j) sum[j] += value * widen(dz(m, j));
    }
  }
}

#endif

}  // namespace
}  // namespace dots
}  // namespace semfield::SEMFIELD_ISA
