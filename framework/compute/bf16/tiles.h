// The tile instructions of AMX, and a portable twin of them with the same bits. For kernel files alone: everything here
// is private to the file and to its instruction set.
#pragma once

#include "compute/gemm_tiles.h"

#if defined(__AVX512F__)
#include <immintrin.h>
#endif

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstring>

#include "compute/isa.h"
#include "compute/layers.h"
#include "core/non_copyable.h"

namespace semfield::SEMFIELD_ISA {
namespace {

inline float widen(Bf16 value) {
  return std::bit_cast<float>(static_cast<std::uint32_t>(value.bits) << 16);
}

/// To nearest, ties to even; values below the normal range count as 0, as the instructions have it.
inline Bf16 rounded(float value) {
  const auto bits = std::bit_cast<std::uint32_t>(value);
  const std::uint32_t exponent = bits & 0x7F800000u;
  if (exponent == 0x7F800000u)
    return {static_cast<std::uint16_t>((bits >> 16) | ((bits & 0x7FFFFFu) != 0 ? 0x40u : 0u))};
  if (exponent == 0) return {static_cast<std::uint16_t>((bits >> 16) & 0x8000u)};
  return {static_cast<std::uint16_t>((bits + 0x7FFFu + ((bits >> 16) & 1u)) >> 16)};
}

inline bool positive(Bf16 value) { return static_cast<std::int16_t>(value.bits) > 0; }

/// Row `row` of what a layer's sums start from; null: zero.
inline const float* start_of(const Layer<Bf16>& l, std::int64_t row) {
  if (l.start.empty()) return nullptr;
  return l.start.row(!l.row_of.empty() ? l.row_of(row, 0) : l.start.rows == 1 ? 0 : row);
}

/// What follows the sums of a layer's row in columns [col, col + cols), cols <= 32, and where they go.
struct RowEnd {
  bool relu;
  const Bf16* mask;  // null: none
  Bf16* y;           // 32 numbers are written, zeros behind the columns; null: `exact`
  float* exact;
};

inline RowEnd row_end(const Layer<Bf16>& l, std::int64_t row, std::int64_t col) {
  return {l.relu, l.mask.empty() ? nullptr : l.mask.row(row) + col, l.y.empty() ? nullptr : l.y.row(row) + col,
          l.exact.empty() ? nullptr : l.exact.row(row) + col};
}

#if defined(__AVX512BF16__)

inline __m512 first_floats(const float* p, std::int64_t count) {
  if (count >= 16) return _mm512_loadu_ps(p);
  return count <= 0 ? _mm512_setzero_ps() : _mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1), p);
}

/// Sums of 32 columns, of which `cols` exist.
inline void finish_row(const RowEnd& end, __m512 left, __m512 right, std::int64_t cols) {
  const auto lanes = static_cast<__mmask32>(cols >= 32 ? ~0u : (1u << cols) - 1);
  if (end.relu) {  // NaN stays NaN
    const __m512 zero = _mm512_setzero_ps();
    left = _mm512_mask_mov_ps(left, _mm512_cmp_ps_mask(left, zero, _CMP_LT_OQ), zero);
    right = _mm512_mask_mov_ps(right, _mm512_cmp_ps_mask(right, zero, _CMP_LT_OQ), zero);
  }
  __mmask32 keep = lanes;
  if (end.mask != nullptr)  // as integers: the positive numbers
    keep = _mm512_mask_cmpgt_epi16_mask(lanes, _mm512_maskz_loadu_epi16(lanes, end.mask), _mm512_setzero_si512());
  if (end.y != nullptr) {
    _mm512_storeu_si512(end.y, _mm512_maskz_mov_epi16(keep, (__m512i)_mm512_cvtne2ps_pbh(right, left)));
    return;
  }
  _mm512_mask_storeu_ps(end.exact, static_cast<__mmask16>(lanes),
                        _mm512_maskz_mov_ps(static_cast<__mmask16>(keep), left));
  _mm512_mask_storeu_ps(end.exact + 16, static_cast<__mmask16>(lanes >> 16),
                        _mm512_maskz_mov_ps(static_cast<__mmask16>(keep >> 16), right));
}
/// Sums in memory, 16 and 16.
inline void finish_row(const RowEnd& end, const float* left, const float* right, std::int64_t cols) {
  finish_row(end, first_floats(left, cols), first_floats(right, cols - 16), cols);
}

/// Word i = (even[i], odd[i]) of 16 numbers.
inline __m512i interleaved(__m256i even, __m256i odd) {
  return _mm512_or_si512(_mm512_cvtepu16_epi32(even), _mm512_slli_epi32(_mm512_cvtepu16_epi32(odd), 16));
}

inline __m512 widened(__m256i numbers) { return (__m512)_mm512_slli_epi32(_mm512_cvtepu16_epi32(numbers), 16); }

#else

inline void finish_row(const RowEnd& end, const float* left, const float* right, std::int64_t cols) {
  for (std::int64_t j = 0; j < 32; ++j) {
    if (j >= cols && end.y == nullptr) return;
    float sum = j >= cols ? 0 : j < 16 ? left[j] : right[j - 16];
    if (end.relu && sum < 0) sum = 0;
    if (j < cols && end.mask != nullptr && !positive(end.mask[j])) sum = 0;
    if (end.y != nullptr) {
      end.y[j] = rounded(sum);
    } else {
      end.exact[j] = sum;
    }
  }
}

#endif

}  // namespace

// Layers in bf16 with the dot products of AVX-512, or written in fp32 where the CPU has none. For kernel files
// alone: everything here is private to the file and to its instruction set.

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
      run_rows(shape, t, row, end, [&](std::int64_t at, int rows) {
        t.a = reinterpret_cast<const std::uint32_t*>(l.x.row(at));
        t.c = sums + (at - row) * kPanel;
        for (int i = 0; i < rows; ++i) {
          const float* start = start_of(l, at + i);
          t.start[i] = start == nullptr ? nullptr : start + first;
        }
      });
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
          run_rows(shape, t, row, std::min<std::int64_t>(row + kRows, x.cols), [&](std::int64_t at, int rows) {
            t.a = a + (at - row);
            t.c = d_weight.row(at) + first;
            for (int i = 0; i < rows; ++i) t.start[i] = t.c + i * t.c_row;
          });
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

namespace semfield::SEMFIELD_ISA {
namespace {

// A tile is 16 rows of 64 bytes: 16 x 16 sums, or 16 x 32 numbers in bf16.
constexpr std::int64_t kTileRows = 16, kTileCols = 16, kTileDepth = 32;
constexpr std::int64_t kTileWords = kTileRows * 16;  // 32-bit words of a tile in memory without gaps

/// The eight tile registers, written in instructions that every CPU has: C += A B as the CPU does it, the
/// products of even and of odd depth summed apart from zero, then together, then into C [Intel SDM, TDPBF16PS].
class EmulatedTiles {
 public:
  template <int kTile>
  void zero() {
    std::memset(tiles_[kTile], 0, sizeof tiles_[kTile]);
  }
  template <int kTile>
  void load(const void* from, std::int64_t stride_bytes) {
    for (std::int64_t i = 0; i < kTileRows; ++i)
      std::memcpy(tiles_[kTile] + i * 16, static_cast<const std::byte*>(from) + i * stride_bytes, 64);
  }
  template <int kTile>
  void store(void* to, std::int64_t stride_bytes) const {
    for (std::int64_t i = 0; i < kTileRows; ++i)
      std::memcpy(static_cast<std::byte*>(to) + i * stride_bytes, tiles_[kTile] + i * 16, 64);
  }
  template <int kC, int kA, int kB>
  void multiply_add() {
    for (std::int64_t m = 0; m < kTileRows; ++m) {
      float even[kTileCols] = {}, odd[kTileCols] = {};
      for (std::int64_t k = 0; k < 16; ++k) {
        const std::uint32_t a = tiles_[kA][m * 16 + k];
        for (std::int64_t n = 0; n < kTileCols; ++n) {
          const std::uint32_t b = tiles_[kB][k * 16 + n];
          even[n] += low(a) * low(b);
          odd[n] += high(a) * high(b);
        }
      }
      for (std::int64_t n = 0; n < kTileCols; ++n) {
        float c;
        std::memcpy(&c, &tiles_[kC][m * 16 + n], sizeof c);
        c += even[n] + odd[n];
        std::memcpy(&tiles_[kC][m * 16 + n], &c, sizeof c);
      }
    }
  }

 private:
  static float number(std::uint32_t bits) {
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
  }
  static float low(std::uint32_t pair) { return number(pair << 16); }
  static float high(std::uint32_t pair) { return number(pair & 0xFFFF0000u); }

  std::uint32_t tiles_[8][kTileWords];
};

#if defined(__x86_64__)
/// The registers themselves, whole tiles, while it lives. Configured by each product: another library of the process
/// may have configured them in between.
class HardwareTiles : NonCopyable {
 public:
  HardwareTiles() {
    struct alignas(64) Config {
      std::uint8_t palette = 1, start_row = 0, reserved[14] = {};
      std::uint16_t row_bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
      std::uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
    };
    static constexpr Config kConfig;
    __asm__ volatile("ldtilecfg %0" ::"m"(kConfig));
  }
  ~HardwareTiles() { __asm__ volatile("tilerelease"); }

  // In assembler: the compilers' own functions for these instructions take the number of a tile as a literal.
  template <int kTile>
  void zero() {
    __asm__ volatile("tilezero %%tmm%c0" ::"i"(kTile));
  }
  template <int kTile>
  void load(const void* from, std::int64_t stride_bytes) {
    __asm__ volatile("tileloadd (%0,%1,1), %%tmm%c2" ::"r"(from), "r"(stride_bytes), "i"(kTile) : "memory");
  }
  template <int kTile>
  void store(void* to, std::int64_t stride_bytes) const {
    __asm__ volatile("tilestored %%tmm%c2, (%0,%1,1)" ::"r"(to), "r"(stride_bytes), "i"(kTile) : "memory");
  }
  template <int kC, int kA, int kB>
  void multiply_add() {
    __asm__ volatile("tdpbf16ps %%tmm%c0, %%tmm%c1, %%tmm%c2" ::"i"(kB), "i"(kA), "i"(kC));
  }
};
#endif

}  // namespace

// Layers in bf16 on tile registers. For kernel files alone: everything here is private to the file and to its
// instruction set.

namespace tiles {
namespace {

constexpr std::int64_t kStrip = 2 * kTileRows, kPair = 2 * kTileCols;  // sums that are made at once

inline std::int64_t tiles_over(std::int64_t count, std::int64_t size) { return (count + size - 1) / size; }

// Packed weights: tiles of B, those of a column tile side by side.
inline std::int64_t packed_words(std::int64_t in, std::int64_t out) {
  return tiles_over(in, kTileDepth) * tiles_over(out, kTileCols) * kTileWords;
}

/// value(k, n) of [in, out].
template <class Value>
void pack_weight(std::int64_t in, std::int64_t out, const Value& value, std::uint32_t* words) {
  for (std::int64_t col = 0; col < out; col += kTileCols) {
    for (std::int64_t k = 0; k < in; k += kTileDepth) {
      for (std::int64_t p = 0; p < kTileRows; ++p) {
        for (std::int64_t j = 0; j < kTileCols; ++j) {
          const std::int64_t even = k + 2 * p, n = col + j;
          const std::uint32_t low = even < in && n < out ? rounded(value(even, n)).bits : 0u;
          const std::uint32_t high = even + 1 < in && n < out ? rounded(value(even + 1, n)).bits : 0u;
          *words++ = low | high << 16;
        }
      }
    }
  }
}

/// Up to 32 x 32 sums and where they stand.
struct Place {
  std::int64_t row, col, rows, cols;
  Place right() const { return {row, col + kTileCols, rows, cols - kTileCols}; }
  Place below() const { return {row + kTileRows, col, rows - kTileRows, cols}; }
};

template <int kTile, class Tiles>
void start_tile(Tiles& tiles, const Layer<Bf16>& l, const Place& at) {
  if (l.start.empty() || at.rows <= 0 || at.cols <= 0) return tiles.template zero<kTile>();
  const bool one = l.start.rows == 1 && l.row_of.empty();
  const bool whole = at.rows >= kTileRows && at.cols >= kTileCols;
  if (whole && one) return tiles.template load<kTile>(l.start.data + at.col, 0);
  if (whole && l.row_of.empty())
    return tiles.template load<kTile>(l.start.row(at.row) + at.col, l.start.row_stride * 4);
  alignas(64) float start[kTileWords];
  const std::int64_t cols = std::min(at.cols, kTileCols);
  for (std::int64_t i = 0; i < kTileRows; ++i) {
    const float* from = start_of(l, std::min(at.row + i, at.row + at.rows - 1)) + at.col;
#if defined(__AVX512BF16__)
    _mm512_store_ps(start + i * kTileCols, first_floats(from, cols));
#else
    for (std::int64_t j = 0; j < kTileCols; ++j) start[i * kTileCols + j] = j < cols ? from[j] : 0;
#endif
  }
  tiles.template load<kTile>(start, 64);
}

/// Up to 16 rows of sums, in two tiles, to the layer's result.
inline void finish_rows(const Layer<Bf16>& l, const Place& at, const float* left, const float* right) {
  for (std::int64_t i = 0; i < std::min(at.rows, kTileRows); ++i)
    finish_row(row_end(l, at.row + i, at.col), left + i * kTileCols, right + i * kTileCols, at.cols);
}

/// The sums of two tiles of A, two of B and four of C: next(k, a0, a1) gives the A of chunk k and its stride in bytes.
template <class Tiles, class Next>
void multiply(Tiles& tiles, std::int64_t chunks, const std::uint32_t* b, const std::uint32_t* second_b,
              const Next& next) {
  for (std::int64_t k = 0; k < chunks; ++k) {
    const void *upper, *lower;
    const std::int64_t stride = next(k, upper, lower);
    tiles.template load<4>(upper, stride);
    tiles.template load<6>(b + k * kTileWords, 64);
    tiles.template multiply_add<0, 4, 6>();
    tiles.template load<7>(second_b + k * kTileWords, 64);
    tiles.template multiply_add<1, 4, 7>();
    tiles.template load<5>(lower, stride);
    tiles.template multiply_add<2, 5, 6>();
    tiles.template multiply_add<3, 5, 7>();
  }
}

/// A strip of up to 32 rows of x against the whole weight.
template <class Tiles>
void layer_strip(Tiles& tiles, const Layer<Bf16>& l, std::int64_t row, std::int64_t rows) {
  const std::int64_t chunks = tiles_over(l.weight.in, kTileDepth), stride = l.x.row_stride;
  const Bf16* const x = l.x.row(row);
  alignas(64) Bf16 part[kStrip * kTileDepth];  // of a strip that ends early: there may be no memory behind it
  const auto whole = [&](std::int64_t k, const void*& upper, const void*& lower) {
    upper = x + k * kTileDepth;
    lower = x + k * kTileDepth + kTileRows * stride;
    return stride * 2;
  };
  const auto short_one = [&](std::int64_t k, const void*& upper, const void*& lower) {
    for (std::int64_t i = 0; i < rows; ++i) std::memcpy(part + i * kTileDepth, x + i * stride + k * kTileDepth, 64);
    upper = part;
    lower = part + kTileRows * kTileDepth;
    return std::int64_t{64};
  };
  if (rows < kStrip) std::memset(part, 0, sizeof part);
  for (std::int64_t col = 0; col < l.weight.out; col += kPair) {
    const Place at{row, col, rows, std::min(kPair, l.weight.out - col)};
    start_tile<0>(tiles, l, at);
    start_tile<1>(tiles, l, at.right());
    start_tile<2>(tiles, l, at.below());
    start_tile<3>(tiles, l, at.below().right());
    const std::uint32_t* b = l.weight.words + col / kTileCols * chunks * kTileWords;
    const std::uint32_t* second_b = at.right().cols > 0 ? b + chunks * kTileWords : b;
    if (rows == kStrip) {
      multiply(tiles, chunks, b, second_b, whole);
    } else {
      multiply(tiles, chunks, b, second_b, short_one);
    }
    alignas(64) float sums[4][kTileWords];
    tiles.template store<0>(sums[0], 64);
    tiles.template store<1>(sums[1], 64);
    finish_rows(l, at, sums[0], sums[1]);
    if (rows <= kTileRows) continue;
    tiles.template store<2>(sums[2], 64);
    tiles.template store<3>(sums[3], 64);
    finish_rows(l, at.below(), sums[2], sums[3]);
  }
}

template <class Tiles>
void layer(const Layer<Bf16>& l) {
  Tiles tiles;
  for (std::int64_t row = 0; row < l.x.rows; row += kStrip)
    layer_strip(tiles, l, row, std::min(kStrip, l.x.rows - row));
}

/// A tile of pairs of rows [row, row + 32), at most `rows` of them, and columns [col, col + 16); zeros behind the last
/// row, and in memory behind the last column.
inline void pair_tile(View<const Bf16> from, std::int64_t row, std::int64_t rows, std::int64_t col,
                      std::uint32_t* out) {
  alignas(64) static constexpr Bf16 kZeros[16] = {};
  for (std::int64_t p = 0; p < kTileRows; ++p, out += kTileCols) {
    const Bf16* even = 2 * p < rows ? from.row(row + 2 * p) + col : kZeros;
    const Bf16* odd = 2 * p + 1 < rows ? from.row(row + 2 * p + 1) + col : kZeros;
#if defined(__AVX512BF16__)
    _mm512_store_si512(out, interleaved(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(even)),
                                        _mm256_loadu_si256(reinterpret_cast<const __m256i*>(odd))));
#else
    for (std::int64_t i = 0; i < 16; ++i) out[i] = even[i].bits | static_cast<std::uint32_t>(odd[i].bits) << 16;
#endif
  }
}

/// out[i][p] = in[p][i] of a tile.
inline void transpose_tile(const std::uint32_t* in, std::uint32_t* out) {
#if defined(__AVX512F__)
  __m512i a[16], b[16];
  for (int i = 0; i < 16; ++i) a[i] = _mm512_load_si512(in + i * 16);
  for (int i = 0; i < 16; i += 4) {  // pairs of words, then of pairs, within quarters
    const __m512i lo0 = _mm512_unpacklo_epi32(a[i], a[i + 1]), hi0 = _mm512_unpackhi_epi32(a[i], a[i + 1]);
    const __m512i lo1 = _mm512_unpacklo_epi32(a[i + 2], a[i + 3]), hi1 = _mm512_unpackhi_epi32(a[i + 2], a[i + 3]);
    b[i] = _mm512_unpacklo_epi64(lo0, lo1);
    b[i + 1] = _mm512_unpackhi_epi64(lo0, lo1);
    b[i + 2] = _mm512_unpacklo_epi64(hi0, hi1);
    b[i + 3] = _mm512_unpackhi_epi64(hi0, hi1);
  }
  for (int i = 0; i < 4; ++i) {  // b[4 g + i] holds column 4 q + i of rows 4 g ... in quarter q
    const __m512i low_even = _mm512_shuffle_i32x4(b[i], b[4 + i], 0x88);
    const __m512i low_odd = _mm512_shuffle_i32x4(b[i], b[4 + i], 0xDD);
    const __m512i high_even = _mm512_shuffle_i32x4(b[8 + i], b[12 + i], 0x88);
    const __m512i high_odd = _mm512_shuffle_i32x4(b[8 + i], b[12 + i], 0xDD);
    _mm512_store_si512(out + i * 16, _mm512_shuffle_i32x4(low_even, high_even, 0x88));
    _mm512_store_si512(out + (8 + i) * 16, _mm512_shuffle_i32x4(low_even, high_even, 0xDD));
    _mm512_store_si512(out + (4 + i) * 16, _mm512_shuffle_i32x4(low_odd, high_odd, 0x88));
    _mm512_store_si512(out + (12 + i) * 16, _mm512_shuffle_i32x4(low_odd, high_odd, 0xDD));
  }
#else
  for (std::int64_t i = 0; i < 16; ++i) {
    for (std::int64_t p = 0; p < 16; ++p) out[i * 16 + p] = in[p * 16 + i];
  }
#endif
}

template <int kTile, class Tiles>
void load_sums(Tiles& tiles, View<float> c, const Place& at) {
  if (at.rows <= 0 || at.cols <= 0) return tiles.template zero<kTile>();
  float* const from = c.row(at.row) + at.col;
  if (at.rows >= kTileRows && at.cols >= kTileCols) return tiles.template load<kTile>(from, c.row_stride * 4);
  alignas(64) float sums[kTileWords] = {};
  for (std::int64_t i = 0; i < std::min(at.rows, kTileRows); ++i)
    std::copy_n(from + i * c.row_stride, std::min(at.cols, kTileCols), sums + i * kTileCols);
  tiles.template load<kTile>(sums, 64);
}

template <int kTile, class Tiles>
void store_sums(const Tiles& tiles, View<float> c, const Place& at) {
  if (at.rows <= 0 || at.cols <= 0) return;
  float* const to = c.row(at.row) + at.col;
  if (at.rows >= kTileRows && at.cols >= kTileCols) return tiles.template store<kTile>(to, c.row_stride * 4);
  alignas(64) float sums[kTileWords];
  tiles.template store<kTile>(sums, 64);
  for (std::int64_t i = 0; i < std::min(at.rows, kTileRows); ++i)
    std::copy_n(sums + i * kTileCols, std::min(at.cols, kTileCols), to + i * c.row_stride);
}

template <class Tiles>
void weight_gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight) {
  // Of dz a block of 512 rows and 256 columns in pairs (256 KiB, in L2), of x strips of 32 columns (32 KiB, in L1).
  constexpr std::int64_t kDepth = 512, kCols = 256, kChunks = kDepth / kTileDepth;
  Tiles tiles;
  alignas(64) std::uint32_t b[kCols / kTileCols * kChunks * kTileWords], a[2 * kChunks * kTileWords];
  alignas(64) std::uint32_t pairs[kTileWords];
  for (std::int64_t k = 0; k < x.rows; k += kDepth) {
    const std::int64_t depth = std::min(kDepth, x.rows - k), chunks = tiles_over(depth, kTileDepth);
    for (std::int64_t first = 0; first < dz.cols; first += kCols) {
      const std::int64_t cols = std::min<std::int64_t>(kCols, dz.cols - first);
      for (std::int64_t t = 0; t < tiles_over(cols, kTileCols); ++t) {
        for (std::int64_t c = 0; c < chunks; ++c)
          pair_tile(dz, k + c * kTileDepth, depth - c * kTileDepth, first + t * kTileCols,
                    b + (t * kChunks + c) * kTileWords);
      }
      for (std::int64_t row = 0; row < x.cols; row += kStrip) {
        const bool second = row + kTileRows < x.cols;
        for (std::int64_t c = 0; c < chunks; ++c) {
          for (std::int64_t t = 0; t < (second ? 2 : 1); ++t) {
            pair_tile(x, k + c * kTileDepth, depth - c * kTileDepth, row + t * kTileRows, pairs);
            transpose_tile(pairs, a + (2 * c + t) * kTileWords);
          }
        }
        for (std::int64_t col = 0; col < cols; col += kPair) {
          const Place at{row, first + col, std::min<std::int64_t>(x.cols - row, kStrip), std::min(cols - col, kPair)};
          load_sums<0>(tiles, d_weight, at);
          load_sums<1>(tiles, d_weight, at.right());
          load_sums<2>(tiles, d_weight, at.below());
          load_sums<3>(tiles, d_weight, at.below().right());
          const std::uint32_t* left = b + col / kTileCols * kChunks * kTileWords;
          const std::uint32_t* right = at.right().cols > 0 ? left + kChunks * kTileWords : left;
          multiply(tiles, chunks, left, right, [&](std::int64_t chunk, const void*& upper, const void*& lower) {
            upper = a + 2 * chunk * kTileWords;
            lower = a + (2 * chunk + (second ? 1 : 0)) * kTileWords;
            return std::int64_t{64};
          });
          store_sums<0>(tiles, d_weight, at);
          store_sums<1>(tiles, d_weight, at.right());
          store_sums<2>(tiles, d_weight, at.below());
          store_sums<3>(tiles, d_weight, at.below().right());
        }
      }
    }
  }
}

}  // namespace
}  // namespace tiles
}  // namespace semfield::SEMFIELD_ISA
