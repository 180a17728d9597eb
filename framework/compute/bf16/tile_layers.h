// Layers in bf16 on tile registers. For kernel files alone: everything here is private to the file and to its
// instruction set.
#pragma once

#include "compute/bf16/numbers.h"
#include "compute/bf16/tiles.h"

namespace semfield::SEMFIELD_ISA {
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
