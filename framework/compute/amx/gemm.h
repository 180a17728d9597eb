// The matrix product of bf16 on tile registers. For kernel files alone: everything here is private to the file and to
// its instruction set.
#pragma once

#include <algorithm>
#include <cmath>

#include "compute/amx/tiles.h"
#include "compute/gemm.h"

namespace semfield::SEMFIELD_ISA {
namespace amx {
namespace {

// A block of B, 512 x 256 (256 KiB, in L2), against strips of 32 rows of A (32 KiB, in L1). The rows of a transposed A
// are columns in memory: those of two strips share each line that is read.
constexpr std::int64_t kBlockK = 512, kBlockN = 256, kStrip = 2 * kTileRows, kStrips = 2;
constexpr std::int64_t kChunks = kBlockK / kTileDepth;

#if defined(__AVX512BF16__)
inline __m512 load_floats(const float* p, std::int64_t n) {
  if (n >= 16) return _mm512_loadu_ps(p);
  return n <= 0 ? _mm512_setzero_ps() : _mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << n) - 1), p);
}
#else
/// To nearest, ties to even; values below the normal range count as 0, as the instructions have it.
inline std::uint32_t bf16_bits(float value) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  const std::uint32_t exponent = bits & 0x7F800000u;
  if (exponent == 0x7F800000u) return (bits >> 16) | ((bits & 0x7FFFFFu) != 0 ? 0x40u : 0u);
  if (exponent == 0) return (bits >> 16) & 0x8000u;
  return (bits + 0x7FFFu + ((bits >> 16) & 1u)) >> 16;
}
#endif

/// One row of a tile of A: in[0 .. 32) in bf16, zeros from `count` on.
inline void pack_row(const float* in, std::int64_t count, std::uint32_t* out) {
#if defined(__AVX512BF16__)
  const __m512 first = load_floats(in, count), second = load_floats(in + 16, count - 16);
  _mm512_store_si512(out, (__m512i)_mm512_cvtne2ps_pbh(second, first));
#else
  for (std::int64_t p = 0; p < 16; ++p) {
    const std::uint32_t first = 2 * p < count ? bf16_bits(in[2 * p]) : 0;
    const std::uint32_t second = 2 * p + 1 < count ? bf16_bits(in[2 * p + 1]) : 0;
    out[p] = first | second << 16;
  }
#endif
}

/// One row of a tile of B: out[i] = (even[i], odd[i]), zeros from `count` on; odd may be null: zeros.
inline void pack_pair(const float* even, const float* odd, std::int64_t count, std::uint32_t* out) {
#if defined(__AVX512BF16__)
  alignas(64) static constexpr std::uint16_t kInterleave[32] = {0,  16, 1,  17, 2,  18, 3,  19, 4,  20, 5,
                                                                21, 6,  22, 7,  23, 8,  24, 9,  25, 10, 26,
                                                                11, 27, 12, 28, 13, 29, 14, 30, 15, 31};
  const __m512 low = load_floats(even, count), high = odd != nullptr ? load_floats(odd, count) : _mm512_setzero_ps();
  _mm512_store_si512(out,
                     _mm512_permutexvar_epi16(_mm512_load_si512(kInterleave), (__m512i)_mm512_cvtne2ps_pbh(high, low)));
#else
  for (std::int64_t i = 0; i < 16; ++i) {
    const std::uint32_t low = i < count ? bf16_bits(even[i]) : 0;
    const std::uint32_t high = i < count && odd != nullptr ? bf16_bits(odd[i]) : 0;
    out[i] = low | high << 16;
  }
#endif
}

/// A tile of B: rows [0, rows) and columns [0, cols) of `in`, zeros beyond.
inline void pack_tile(const float* in, std::int64_t stride, std::int64_t rows, std::int64_t cols, std::uint32_t* out) {
  for (std::int64_t p = 0; p < kTileRows; ++p) {
    const float* even = in + 2 * p * stride;
    if (2 * p < rows) {
      pack_pair(even, 2 * p + 1 < rows ? even + stride : nullptr, cols, out + p * 16);
    } else {
      std::memset(out + p * 16, 0, 64);
    }
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

/// What a block multiplies and where its sums go.
struct Block {
  std::int64_t col0, cols;  // of C
  std::int64_t k0, depth;
  bool first, last;  // of the blocks over k
  std::int64_t chunks() const { return (depth + kTileDepth - 1) / kTileDepth; }
  std::int64_t column_tiles() const { return (cols + kTileCols - 1) / kTileCols; }
};

/// Rows [row, row + rows) of A, in tiles: those of a chunk side by side, 2 tiles a strip.
inline void pack_strip(const Gemm<float>& g, const Block& b, std::int64_t row, std::int64_t rows, std::uint32_t* out) {
  float line[kTileDepth];
  for (std::int64_t i = 0; i < kStrip; ++i) {
    std::uint32_t* to = out + i / kTileRows * kTileWords + i % kTileRows * 16;
    const float* from = g.a + (row + i) * g.a_row + b.k0 * g.a_col;
    for (std::int64_t c = 0; c < b.chunks(); ++c, to += 2 * kTileWords) {
      const std::int64_t count = i < rows ? std::min(kTileDepth, b.depth - c * kTileDepth) : 0;
      if (g.a_col == 1) {
        pack_row(from + c * kTileDepth, count, to);
      } else {
        for (std::int64_t k = 0; k < count; ++k) line[k] = from[(c * kTileDepth + k) * g.a_col];
        pack_row(line, count, to);
      }
    }
  }
}

/// The same of an A whose columns are contiguous, kStrips strips at once, each kChunks * 2 tiles long.
inline void pack_columns(const Gemm<float>& g, const Block& b, std::int64_t row, std::int64_t rows,
                         std::uint32_t* out) {
  alignas(64) std::uint32_t pairs[kTileWords];
  for (std::int64_t c = 0; c < b.chunks(); ++c) {
    const float* from = g.a + row + (b.k0 + c * kTileDepth) * g.a_col;
    const std::int64_t depth = std::min(kTileDepth, b.depth - c * kTileDepth);
    for (std::int64_t t = 0; t < 2 * kStrips && t / 2 * kStrip < rows; ++t) {
      pack_tile(from + t * kTileRows, g.a_col, depth, rows - t * kTileRows, pairs);
      transpose_tile(pairs, out + ((t / 2 * kChunks + c) * 2 + t % 2) * kTileWords);
    }
  }
}

/// A tile of C: where it stands and how much of it exists.
struct Place {
  std::int64_t row, col, rows, cols;
  bool whole() const { return rows == kTileRows && cols == kTileCols; }
};

/// The tile's sums before the first product of this block.
template <int kTile, class Tiles>
void start_tile(Tiles& tiles, const Gemm<float>& g, const Block& b, const Place& at) {
  float* c = g.c + at.row * g.c_row + at.col;
  if (at.rows <= 0 || at.cols <= 0 || (b.first && !g.accumulate && g.bias == nullptr && g.row_term == nullptr)) {
    tiles.template zero<kTile>();
    return;
  }
  const bool from_c = g.accumulate || !b.first;
  if (at.whole() && from_c) return tiles.template load<kTile>(c, g.c_row * 4);
  if (at.whole() && g.bias != nullptr) return tiles.template load<kTile>(g.bias + at.col, 0);
  alignas(64) float start[kTileWords] = {};
  for (std::int64_t i = 0; i < at.rows; ++i) {
    const float* from =
        from_c ? c + i * g.c_row
        : g.bias != nullptr
            ? g.bias + at.col
            : g.row_term + at.col +
                  (g.row_of != nullptr ? g.row_of[(at.row + i) * g.row_of_stride] : at.row + i) * g.row_term_stride;
    for (std::int64_t j = 0; j < at.cols; ++j) start[i * kTileCols + j] = from[j];
  }
  tiles.template load<kTile>(start, 64);
}

/// The tile's sums to memory, after the last block with what follows them.
template <int kTile, class Tiles>
void finish_tile(const Tiles& tiles, const Gemm<float>& g, const Block& b, const Place& at) {
  if (at.rows <= 0 || at.cols <= 0) return;
  float* c = g.c + at.row * g.c_row + at.col;
  const bool relu = g.relu && b.last;
  const float* mask = b.last && g.mask != nullptr ? g.mask + at.row * g.mask_row + at.col : nullptr;
  if (at.whole() && !relu && mask == nullptr) return tiles.template store<kTile>(c, g.c_row * 4);
  alignas(64) float sums[kTileWords];
  tiles.template store<kTile>(sums, 64);
#if defined(__AVX512F__)
  const auto lanes = static_cast<__mmask16>((1u << at.cols) - 1);
  const __m512 zero = _mm512_setzero_ps();
  for (std::int64_t i = 0; i < at.rows; ++i) {
    __m512 v = _mm512_load_ps(sums + i * kTileCols);
    if (relu) v = _mm512_mask_mov_ps(v, _mm512_cmp_ps_mask(v, zero, _CMP_LT_OQ), zero);  // NaN stays NaN
    if (mask != nullptr) {
      const __m512 keep = _mm512_maskz_loadu_ps(lanes, mask + i * g.mask_row);
      v = _mm512_maskz_mov_ps(_mm512_cmp_ps_mask(keep, zero, _CMP_GT_OQ), v);
    }
    _mm512_mask_storeu_ps(c + i * g.c_row, lanes, v);
  }
#else
  for (std::int64_t i = 0; i < at.rows; ++i) {
    for (std::int64_t j = 0; j < at.cols; ++j) {
      float v = sums[i * kTileCols + j];
      if (relu && v < 0) v = 0;
      if (mask != nullptr && !(mask[i * g.mask_row + j] > 0)) v = 0;
      c[i * g.c_row + j] = v;
    }
  }
#endif
}

/// 32 x 32 sums: two tiles of A, two of B, four of C.
template <class Tiles>
void quad(Tiles& tiles, const Gemm<float>& g, const Block& b, const Place& at, const std::uint32_t* packed_a,
          const std::uint32_t* packed_b) {
  const Place left{at.row, at.col, std::min(at.rows, kTileRows), std::min(at.cols, kTileCols)};
  const Place right{at.row, at.col + kTileCols, left.rows, at.cols - kTileCols};
  const Place below{at.row + kTileRows, at.col, at.rows - kTileRows, left.cols};
  const Place corner{below.row, right.col, below.rows, right.cols};
  start_tile<0>(tiles, g, b, left);
  start_tile<1>(tiles, g, b, right);
  start_tile<2>(tiles, g, b, below);
  start_tile<3>(tiles, g, b, corner);
  const std::int64_t chunks = b.chunks();
  const std::uint32_t* second_b = packed_b + (right.cols > 0 ? kChunks * kTileWords : 0);
  for (std::int64_t k = 0; k < chunks; ++k) {
    tiles.template load<4>(packed_a + 2 * k * kTileWords, 64);
    tiles.template load<6>(packed_b + k * kTileWords, 64);
    tiles.template multiply_add<0, 4, 6>();
    tiles.template load<7>(second_b + k * kTileWords, 64);
    tiles.template multiply_add<1, 4, 7>();
    tiles.template load<5>(packed_a + (2 * k + 1) * kTileWords, 64);
    tiles.template multiply_add<2, 5, 6>();
    tiles.template multiply_add<3, 5, 7>();
  }
  finish_tile<0>(tiles, g, b, left);
  finish_tile<1>(tiles, g, b, right);
  finish_tile<2>(tiles, g, b, below);
  finish_tile<3>(tiles, g, b, corner);
}

template <class Tiles>
void multiply(Tiles& tiles, const Gemm<float>& g, const Block& b) {
  alignas(64) std::uint32_t packed_b[kBlockN / kTileCols * kChunks * kTileWords];
  alignas(64) std::uint32_t packed_a[kStrips * 2 * kChunks * kTileWords];
  for (std::int64_t c = 0; c < b.chunks(); ++c) {
    const float* from = g.b + (b.k0 + c * kTileDepth) * g.b_row + b.col0;
    for (std::int64_t t = 0; t < b.column_tiles(); ++t) {
      pack_tile(from + t * kTileCols, g.b_row, b.depth - c * kTileDepth, b.cols - t * kTileCols,
                packed_b + (t * kChunks + c) * kTileWords);
    }
  }
  const bool transposed = g.a_row == 1 && g.a_col != 1;
  for (std::int64_t row = 0, n = 0; row < g.m; row += kStrip, ++n) {
    const std::int64_t strip = transposed ? n % kStrips : 0;
    std::uint32_t* a = packed_a + strip * 2 * kChunks * kTileWords;
    if (!transposed) {
      pack_strip(g, b, row, std::min(kStrip, g.m - row), a);
    } else if (strip == 0) {
      pack_columns(g, b, row, std::min(kStrips * kStrip, g.m - row), a);
    }
    for (std::int64_t t = 0; t < b.column_tiles(); t += 2) {
      const Place at{row, b.col0 + t * kTileCols, g.m - row, b.cols - t * kTileCols};
      quad(tiles, g, b, {at.row, at.col, std::min(at.rows, kStrip), std::min(at.cols, 2 * kTileCols)}, a,
           packed_b + t * kChunks * kTileWords);
    }
  }
}

template <class Tiles>
void gemm(const Gemm<float>& g) {
  Tiles tiles;
  for (std::int64_t col = 0; col < g.n; col += kBlockN) {
    for (std::int64_t k = 0; k == 0 || k < g.k; k += kBlockK) {
      multiply(tiles, g,
               {col, std::min(kBlockN, g.n - col), k, std::min(kBlockK, g.k - k), k == 0, k + kBlockK >= g.k});
    }
  }
}

}  // namespace
}  // namespace amx
}  // namespace semfield::SEMFIELD_ISA
