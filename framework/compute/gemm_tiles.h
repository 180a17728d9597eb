// Register tiles of the matrix product, in the compiler's vector extensions; intrinsics only where the compiler must
// have no choice. For the kernel files alone: everything here is private to the file and to its instruction set.
#pragma once

#if defined(__FMA__)
#include <immintrin.h>
#endif

#include <algorithm>
#include <cstdint>
#include <cstring>

#include "compute/gemm.h"
#include "compute/isa.h"

namespace semfield::SEMFIELD_ISA {
namespace {

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX2__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

// Explicit vector types: the compiler's own choice for this machine may be half the register width. Bytes is the width
// of a whole vector, or half of it for products with very few columns.
template <class T, int kBytes>
struct Simd {
  typedef T Vec __attribute__((vector_size(kBytes)));
  typedef T Loose __attribute__((vector_size(kBytes), aligned(sizeof(T)), may_alias));
  static constexpr int kLanes = kBytes / static_cast<int>(sizeof(T));
};

// acc += value * b, fused in every lane. Spelled out: left to contraction, GCC splits the multiply-add in tiles of one
// or two rows (its tuning avoids long chains), and then an element's bits would depend on the tile that it fell into.
template <class Real>
struct MultiplyAdd {
  using In = Real;
  using Out = Real;
  template <int kBytes>
  static inline __attribute__((always_inline)) void add(typename Simd<Real, kBytes>::Vec& acc, Real value,
                                                        typename Simd<Real, kBytes>::Vec b) {
#if defined(__FMA__)
    using Vec = typename Simd<Real, kBytes>::Vec;
    constexpr bool kSingle = sizeof(Real) == 4;
#if defined(__AVX512F__)
    if constexpr (kBytes == 64 && kSingle) {
      acc = (Vec)_mm512_fmadd_ps(_mm512_set1_ps(value), (__m512)b, (__m512)acc);
    } else if constexpr (kBytes == 64) {
      acc = (Vec)_mm512_fmadd_pd(_mm512_set1_pd(value), (__m512d)b, (__m512d)acc);
    } else
#endif
        if constexpr (kBytes == 32 && kSingle) {
      acc = (Vec)_mm256_fmadd_ps(_mm256_set1_ps(value), (__m256)b, (__m256)acc);
    } else if constexpr (kBytes == 32) {
      acc = (Vec)_mm256_fmadd_pd(_mm256_set1_pd(value), (__m256d)b, (__m256d)acc);
    } else if constexpr (kSingle) {
      acc = (Vec)_mm_fmadd_ps(_mm_set1_ps(value), (__m128)b, (__m128)acc);
    } else {
      acc = (Vec)_mm_fmadd_pd(_mm_set1_pd(value), (__m128d)b, (__m128d)acc);
    }
#else
    acc += value * b;
#endif
  }
};

#if defined(__AVX512BF16__)
/// acc += a.low * b.low + a.high * b.high: In is a pair of bf16 of two consecutive k, the lower one in the low half.
struct PairDot {
  using In = std::uint32_t;
  using Out = float;
  template <int kBytes>
  static inline __attribute__((always_inline)) void add(typename Simd<float, kBytes>::Vec& acc, std::uint32_t value,
                                                        typename Simd<std::uint32_t, kBytes>::Vec b) {
    using Vec = typename Simd<float, kBytes>::Vec;
    if constexpr (kBytes == 64) {
      acc = (Vec)_mm512_dpbf16_ps((__m512)acc, (__m512bh)_mm512_set1_epi32(static_cast<int>(value)), (__m512bh)b);
    } else {
      acc = (Vec)_mm256_dpbf16_ps((__m256)acc, (__m256bh)_mm256_set1_epi32(static_cast<int>(value)), (__m256bh)b);
    }
  }
};
#endif

// Tile shapes. 32 registers (AVX-512): 24 accumulators, the vectors of B and one broadcast; 16 registers: 12
// accumulators. One tile element costs 1 FMA; a k step loads kVecs vectors and kRows broadcasts, so wide tiles keep the
// load ports free.
constexpr int kMaxVecs = kVectorBytes == 64 ? 4 : 2;
constexpr int rows_of_tile(int vecs) {
  if (kVectorBytes == 64) return vecs == 4 ? 6 : vecs == 3 ? 8 : 12;
  return kVectorBytes == 32 ? (vecs == 2 ? 6 : 8) : 4;
}
constexpr int kMaxRows = 12;

template <class Op>
struct TileArgs {
  using In = typename Op::In;
  using Out = typename Op::Out;
  const In* a;
  std::int64_t a_step;  // between rows when A's columns are contiguous, between columns when its rows are
  const In* b;
  std::int64_t b_row;
  Out* c;
  std::int64_t c_row;
  const Out* start[kMaxRows];  // first element of each row's start; null: zero
  const Out* mask;             // of the tile's first element; null: none
  std::int64_t mask_row;
  std::int64_t k;
  int cols;  // of the tile's kVecs * kLanes columns, those that exist
  bool relu;
};

#if defined(__AVX512F__)
// The 32-bit words of the first `count` numbers.
template <class Real>
inline __mmask16 first_words(int count) {
  return static_cast<__mmask16>((1u << (count * static_cast<int>(sizeof(Real) / 4))) - 1);
}
#endif

// The first `cols` lanes of a vector (none when cols <= 0), zeros beyond; memory past them is never touched.
template <class S, class Real>
inline typename S::Vec load_part(const Real* p, int cols) {
  const int count = std::clamp(cols, 0, S::kLanes);
#if defined(__AVX512F__)
  if constexpr (sizeof(typename S::Vec) == 64) return (typename S::Vec)_mm512_maskz_loadu_ps(first_words<Real>(count), p);
#endif
  alignas(64) Real buffer[S::kLanes] = {};
  for (int i = 0; i < count; ++i) buffer[i] = p[i];
  return *reinterpret_cast<const typename S::Loose*>(buffer);
}

template <class S, class Real>
inline void store_part(Real* p, typename S::Vec v, int cols) {
  const int count = std::clamp(cols, 0, S::kLanes);
#if defined(__AVX512F__)
  if constexpr (sizeof(typename S::Vec) == 64) return _mm512_mask_storeu_ps(p, first_words<Real>(count), (__m512)v);
#endif
  for (int i = 0; i < count; ++i) p[i] = v[i];
}

/// One tile of C: kRows x (kVecs * kLanes) accumulators in registers, one pass over k.
template <class Op, int kBytes, int kRows, int kVecs, bool kTransposedA>
__attribute__((noinline)) void tile(const TileArgs<Op>& t) {
  using In = typename Op::In;
  using Out = typename Op::Out;
  using S = Simd<Out, kBytes>;
  using Vec = typename S::Vec;
  using InVec = typename Simd<In, kBytes>::Vec;
  using InLoose = typename Simd<In, kBytes>::Loose;
  using Loose = typename S::Loose;
  constexpr int kLanes = S::kLanes;
  const bool whole = t.cols == kVecs * kLanes;
  Vec acc[kRows][kVecs];
#pragma GCC unroll 16
  for (int i = 0; i < kRows; ++i) {
#pragma GCC unroll 4
    for (int j = 0; j < kVecs; ++j) {
      if (t.start[i] == nullptr) {
        acc[i][j] = Vec{};
      } else if (whole) {
        acc[i][j] = *reinterpret_cast<const Loose*>(t.start[i] + j * kLanes);
      } else {
        acc[i][j] = load_part<S>(t.start[i] + j * kLanes, t.cols - j * kLanes);
      }
    }
  }
  const In* a = t.a;
  const In* b = t.b;
  const std::int64_t a_step = t.a_step;
  const std::int64_t b_row = t.b_row;
  for (std::int64_t k = t.k; k > 0; --k) {
    InVec bv[kVecs];
#pragma GCC unroll 4
    for (int j = 0; j < kVecs; ++j) bv[j] = *reinterpret_cast<const InLoose*>(b + j * kLanes);
#pragma GCC unroll 16
    for (int i = 0; i < kRows; ++i) {
      const In value = kTransposedA ? a[i] : a[i * a_step];
#pragma GCC unroll 4
      for (int j = 0; j < kVecs; ++j) Op::template add<kBytes>(acc[i][j], value, bv[j]);
    }
    a += kTransposedA ? a_step : 1;
    b += b_row;
  }
#pragma GCC unroll 16
  for (int i = 0; i < kRows; ++i) {
#pragma GCC unroll 4
    for (int j = 0; j < kVecs; ++j) {
      Vec v = acc[i][j];
      if (t.relu) v = v < Out(0) ? Vec{} : v;
      if (t.mask != nullptr) {
        const Out* m = t.mask + i * t.mask_row + j * kLanes;
        const Vec keep = whole ? Vec(*reinterpret_cast<const Loose*>(m)) : load_part<S>(m, t.cols - j * kLanes);
        v = keep > Out(0) ? v : Vec{};
      }
      Out* c = t.c + i * t.c_row + j * kLanes;
      if (whole) {
        *reinterpret_cast<Loose*>(c) = v;
      } else {
        store_part<S>(c, v, t.cols - j * kLanes);
      }
    }
  }
}

template <class Op>
using TileFunction = void (*)(const TileArgs<Op>&);

// Full height, 4 rows, 2 rows, 1 row.
template <class Op, int kBytes, int kVecs, bool kTransposedA>
constexpr TileFunction<Op> kTiles[4] = {
    tile<Op, kBytes, rows_of_tile(kVecs), kVecs, kTransposedA>, tile<Op, kBytes, 4, kVecs, kTransposedA>,
    tile<Op, kBytes, 2, kVecs, kTransposedA>, tile<Op, kBytes, 1, kVecs, kTransposedA>};

/// How the columns of a panel are covered.
template <class Op>
struct Cover {
  int width;  ///< columns with padding
  int rows;   ///< of a full tile
  const TileFunction<Op>* tiles;
};

template <class Op, int kBytes, int kVecs>
Cover<Op> cover(bool transposed) {
  return {kVecs * Simd<typename Op::Out, kBytes>::kLanes, rows_of_tile(kVecs),
          transposed ? kTiles<Op, kBytes, kVecs, true> : kTiles<Op, kBytes, kVecs, false>};
}

template <class Op>
constexpr int kLanesOf = kVectorBytes / static_cast<int>(sizeof(typename Op::Out));

template <class Op>
Cover<Op> cover_of(int cols, bool transposed) {
  const int vecs = (cols + kLanesOf<Op> - 1) / kLanesOf<Op>;
  if constexpr (kMaxVecs == 4) {
    if (vecs == 4) return cover<Op, kVectorBytes, 4>(transposed);
    if (vecs == 3) return cover<Op, kVectorBytes, 3>(transposed);
    // Two half-width multiply-adds start in the time of one whole one.
    if (cols <= kLanesOf<Op> / 2) return cover<Op, kVectorBytes / 2, 1>(transposed);
  }
  return vecs == 2 ? cover<Op, kVectorBytes, 2>(transposed) : cover<Op, kVectorBytes, 1>(transposed);
}

/// Where row `row` of C starts from at column `col`, before the first k; null: zero.
template <class Real>
const Real* start_of_row(const Gemm<Real>& g, std::int64_t row, std::int64_t col) {
  if (g.accumulate) return g.c + row * g.c_row + col;
  if (g.bias) return g.bias + col;
  if (g.row_term) return g.row_term + (g.row_of ? g.row_of[row * g.row_of_stride] : row) * g.row_term_stride + col;
  return nullptr;
}

/// Runs the tiles of rows [row, end) of C; place(row, rows) fills `t` for one that begins there.
template <class Op, class Place>
inline void run_rows(const Cover<Op>& shape, const TileArgs<Op>& t, std::int64_t row, std::int64_t end,
                     const Place& place) {
  while (row < end) {
    const std::int64_t left = end - row;
    const int index = left >= shape.rows ? 0 : left >= 4 ? 1 : left >= 2 ? 2 : 3;
    const int rows = index == 0 ? shape.rows : 8 >> index;
    place(row, rows);
    shape.tiles[index](t);
    row += rows;
  }
}

/// Runs the tiles of rows [row, end) of C over one panel, rows [k0, k0 + count) of B: `t` holds its B, k and columns;
/// place(row, rows) sets A for a tile that begins there.
template <class Op, class Place>
inline void run_tiles(const Gemm<typename Op::Out>& g, const Cover<Op>& shape, TileArgs<Op>& t, std::int64_t row,
                      std::int64_t end, std::int64_t col, std::int64_t k0, std::int64_t count, const Place& place) {
  const bool first_k = k0 == 0, last_k = k0 + count == g.k;
  t.c_row = g.c_row;
  t.mask_row = g.mask_row;
  t.relu = g.relu && last_k;
  run_rows(shape, t, row, end, [&](std::int64_t at, int rows) {
    place(at, rows);
    t.c = g.c + at * g.c_row + col;
    t.mask = last_k && g.mask != nullptr ? g.mask + at * g.mask_row + col : nullptr;
    for (int i = 0; i < rows; ++i) t.start[i] = first_k ? start_of_row(g, at + i, col) : t.c + i * g.c_row;
  });
}

}  // namespace
}  // namespace semfield::SEMFIELD_ISA
