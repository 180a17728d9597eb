// Register-blocked matrix product in the compiler's vector extensions; intrinsics only where the compiler must have no
// choice.
#include "core/gemm.h"

#if defined(__FMA__)
#include <immintrin.h>
#endif

#include <algorithm>
#include <cstring>

#include "core/check.h"

namespace semfield {

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
template <class Real, int kBytes>
struct Simd {
  typedef Real Vec __attribute__((vector_size(kBytes)));
  typedef Real Loose __attribute__((vector_size(kBytes), aligned(sizeof(Real)), may_alias));
  static constexpr int kLanes = kBytes / static_cast<int>(sizeof(Real));
};
template <class Real>
constexpr int kLanesOf = kVectorBytes / static_cast<int>(sizeof(Real));

// acc += value * b, fused in every lane. Spelled out: left to contraction, GCC splits the multiply-add in tiles of one
// or two rows (its tuning avoids long chains), and then an element's bits would depend on the tile that it fell into.
template <class S, class Real>
inline void multiply_add(typename S::Vec& acc, Real value, typename S::Vec b) {
#if defined(__FMA__)
  using Vec = typename S::Vec;
  constexpr bool kSingle = sizeof(Real) == 4;
#if defined(__AVX512F__)
  if constexpr (sizeof(Vec) == 64 && kSingle) {
    acc = (Vec)_mm512_fmadd_ps(_mm512_set1_ps(value), (__m512)b, (__m512)acc);
  } else if constexpr (sizeof(Vec) == 64) {
    acc = (Vec)_mm512_fmadd_pd(_mm512_set1_pd(value), (__m512d)b, (__m512d)acc);
  } else
#endif
      if constexpr (sizeof(Vec) == 32 && kSingle) {
    acc = (Vec)_mm256_fmadd_ps(_mm256_set1_ps(value), (__m256)b, (__m256)acc);
  } else if constexpr (sizeof(Vec) == 32) {
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

// Tile shapes. 32 registers (AVX-512): 24 accumulators, the vectors of B and one broadcast; 16 registers: 12
// accumulators. One tile element costs 1 FMA; a k step loads kVecs vectors and kRows broadcasts, so wide tiles keep the
// load ports free.
constexpr int kMaxVecs = kVectorBytes == 64 ? 4 : 2;
constexpr int rows_of_tile(int vecs) {
  if (kVectorBytes == 64) return vecs == 4 ? 6 : vecs == 3 ? 8 : 12;
  return kVectorBytes == 32 ? (vecs == 2 ? 6 : 8) : 4;
}
// Rows of B per block: the packed panel (kBlockK x kMaxVecs vectors, 64 KiB at 64-byte vectors) streams from L2 once a
// tile.
constexpr std::int64_t kBlockK = 256;
constexpr int kMaxRows = 12;

template <class Real>
struct TileArgs {
  const Real* a;
  std::int64_t a_step;  // a_row when A's columns are contiguous, a_col when its rows are
  const Real* b;
  std::int64_t b_row;
  Real* c;
  std::int64_t c_row;
  const Real* start[kMaxRows];  // first element of each row's start; null: zero
  std::int64_t k;
  int cols;  // of the tile's kVecs * kLanes columns, those that exist
  bool relu;
};

// The first `cols` lanes of a vector (none when cols <= 0), zeros beyond; memory past them is never touched.
template <class S, class Real>
inline typename S::Vec load_part(const Real* p, int cols) {
  const int count = std::clamp(cols, 0, S::kLanes);
#if defined(__AVX512F__)
  if constexpr (sizeof(typename S::Vec) == 64) {
    if constexpr (sizeof(Real) == 4) {
      return (typename S::Vec)_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1), p);
    } else {
      return (typename S::Vec)_mm512_maskz_loadu_pd(static_cast<__mmask8>((1u << count) - 1), p);
    }
  }
#endif
  alignas(64) Real buffer[S::kLanes] = {};
  for (int i = 0; i < count; ++i) buffer[i] = p[i];
  return *reinterpret_cast<const typename S::Loose*>(buffer);
}

template <class S, class Real>
inline void store_part(Real* p, typename S::Vec v, int cols) {
  const int count = std::clamp(cols, 0, S::kLanes);
#if defined(__AVX512F__)
  if constexpr (sizeof(typename S::Vec) == 64) {
    if constexpr (sizeof(Real) == 4) {
      _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << count) - 1), (__m512)v);
    } else {
      _mm512_mask_storeu_pd(p, static_cast<__mmask8>((1u << count) - 1), (__m512d)v);
    }
    return;
  }
#endif
  for (int i = 0; i < count; ++i) p[i] = v[i];
}

/// One tile of C: kRows x (kVecs * kLanes) accumulators in registers, one pass over k.
template <class Real, int kBytes, int kRows, int kVecs, bool kTransposedA>
__attribute__((noinline)) void tile(const TileArgs<Real>& t) {
  using S = Simd<Real, kBytes>;
  using Vec = typename S::Vec;
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
  const Real* a = t.a;
  const Real* b = t.b;
  const std::int64_t a_step = t.a_step;
  const std::int64_t b_row = t.b_row;
  for (std::int64_t k = t.k; k > 0; --k) {
    Vec bv[kVecs];
#pragma GCC unroll 4
    for (int j = 0; j < kVecs; ++j) bv[j] = *reinterpret_cast<const Loose*>(b + j * kLanes);
#pragma GCC unroll 16
    for (int i = 0; i < kRows; ++i) {
      const Real value = kTransposedA ? a[i] : a[i * a_step];
#pragma GCC unroll 4
      for (int j = 0; j < kVecs; ++j) multiply_add<S>(acc[i][j], value, bv[j]);
    }
    a += kTransposedA ? a_step : 1;
    b += b_row;
  }
#pragma GCC unroll 16
  for (int i = 0; i < kRows; ++i) {
#pragma GCC unroll 4
    for (int j = 0; j < kVecs; ++j) {
      Vec v = acc[i][j];
      if (t.relu) v = v < Real(0) ? Vec{} : v;
      Real* c = t.c + i * t.c_row + j * kLanes;
      if (whole) {
        *reinterpret_cast<Loose*>(c) = v;
      } else {
        store_part<S>(c, v, t.cols - j * kLanes);
      }
    }
  }
}

template <class Real>
using TileFunction = void (*)(const TileArgs<Real>&);

struct TileChoice {
  int rows;
  int index;  // into the functions of a width: 0 full height, 1: 4 rows, 2: 2 rows, 3: 1 row
};

inline TileChoice choose_rows(std::int64_t left, int full) {
  if (left >= full) return {full, 0};
  if (left >= 4) return {4, 1};
  return left >= 2 ? TileChoice{2, 2} : TileChoice{1, 3};
}

template <class Real, int kBytes, int kVecs, bool kTransposedA>
inline constexpr TileFunction<Real> kTiles[4] = {
    tile<Real, kBytes, rows_of_tile(kVecs), kVecs, kTransposedA>, tile<Real, kBytes, 4, kVecs, kTransposedA>,
    tile<Real, kBytes, 2, kVecs, kTransposedA>, tile<Real, kBytes, 1, kVecs, kTransposedA>};

/// How the columns of a panel are covered.
template <class Real>
struct Cover {
  int width;  ///< columns with padding
  int rows;   ///< of a full tile
  const TileFunction<Real>* tiles;
};

template <class Real, int kBytes, int kVecs>
Cover<Real> cover(bool transposed) {
  return {kVecs * Simd<Real, kBytes>::kLanes, rows_of_tile(kVecs),
          transposed ? kTiles<Real, kBytes, kVecs, true> : kTiles<Real, kBytes, kVecs, false>};
}

template <class Real>
Cover<Real> cover_of(int cols, bool transposed) {
  const int vecs = (cols + kLanesOf<Real> - 1) / kLanesOf<Real>;
  if constexpr (kMaxVecs == 4) {
    if (vecs == 4) return cover<Real, kVectorBytes, 4>(transposed);
    if (vecs == 3) return cover<Real, kVectorBytes, 3>(transposed);
    // Two half-width multiply-adds start in the time of one whole one.
    if (cols <= kLanesOf<Real> / 2) return cover<Real, kVectorBytes / 2, 1>(transposed);
  }
  return vecs == 2 ? cover<Real, kVectorBytes, 2>(transposed) : cover<Real, kVectorBytes, 1>(transposed);
}

template <class Real>
const Real* start_of_row(const Gemm<Real>& g, std::int64_t row, std::int64_t col) {
  if (g.accumulate) return g.c + row * g.c_row + col;
  if (g.bias) return g.bias + col;
  if (g.row_term) return g.row_term + (g.row_of ? g.row_of[row * g.row_of_stride] : row) * g.row_term_stride + col;
  return nullptr;
}

/// Columns [col, col + cols) of C, rows k0 .. k0+count of B: the panel of B is packed to contiguous, zero-padded rows.
template <class Real>
void panel(const Gemm<Real>& g, std::int64_t col, int cols, std::int64_t k0, std::int64_t count) {
  alignas(64) Real packed[kBlockK * kMaxVecs * kLanesOf<Real>];
  const bool transposed = g.a_row == 1 && g.a_col != 1;
  const Cover<Real> shape = cover_of<Real>(cols, transposed);
  const int width = shape.width;
  const Real* b = g.b + k0 * g.b_row + col;
  std::int64_t b_row = g.b_row;
  // Packing costs one copy of the panel: worth it when several tiles read it, needed when its last vector is partial.
  if (b_row != width && (cols != width || g.m >= 2 * shape.rows)) {
    for (std::int64_t k = 0; k < count; ++k) {
      Real* row = packed + k * width;
      std::memcpy(row, b + k * b_row, sizeof(Real) * static_cast<std::size_t>(cols));
      std::fill(row + cols, row + width, Real(0));
    }
    b = packed;
    b_row = width;
  }
  Real strip[kMaxRows * kBlockK];  // rows of A when neither of its strides is 1
  TileArgs<Real> t{};
  t.b = b;
  t.b_row = b_row;
  t.c_row = g.c_row;
  t.k = count;
  t.cols = cols;
  t.relu = g.relu && k0 + count == g.k;
  for (std::int64_t row = 0; row < g.m;) {
    const TileChoice choice = choose_rows(g.m - row, shape.rows);
    t.a = g.a + row * g.a_row + k0 * g.a_col;
    t.a_step = transposed ? g.a_col : g.a_row;
    if (!transposed && g.a_col != 1) {
      for (int i = 0; i < choice.rows; ++i) {
        for (std::int64_t k = 0; k < count; ++k) strip[i * kBlockK + k] = t.a[i * g.a_row + k * g.a_col];
      }
      t.a = strip;
      t.a_step = kBlockK;
    }
    t.c = g.c + row * g.c_row + col;
    for (int i = 0; i < choice.rows; ++i) {
      t.start[i] = k0 > 0 ? t.c + i * g.c_row : start_of_row(g, row + i, col);
    }
    shape.tiles[choice.index](t);
    row += choice.rows;
  }
}

}  // namespace

template <class Real>
void gemm(const Gemm<Real>& g) {
  SEMFIELD_CHECK(int{g.accumulate} + int{g.bias != nullptr} + int{g.row_term != nullptr} <= 1,
                 "a matrix product starts from one of: its old value, a bias, a row term");
  constexpr std::int64_t kPanel = kMaxVecs * kLanesOf<Real>;
  for (std::int64_t col = 0; col < g.n; col += kPanel) {
    const int cols = static_cast<int>(std::min(kPanel, g.n - col));
    // With k = 0 one empty block still writes the start.
    for (std::int64_t k0 = 0; k0 == 0 || k0 < g.k; k0 += kBlockK) panel(g, col, cols, k0, std::min(kBlockK, g.k - k0));
  }
}

template <class Real>
void gemm(View<const Real> a, View<const Real> b, View<Real> c, bool accumulate) {
  SEMFIELD_CHECK(a.cols == b.rows && a.rows == c.rows && b.cols == c.cols, "shapes of a matrix product do not fit");
  gemm(Gemm<Real>{.m = a.rows,
                  .n = b.cols,
                  .k = a.cols,
                  .a = a.data,
                  .a_row = a.row_stride,
                  .b = b.data,
                  .b_row = b.row_stride,
                  .c = c.data,
                  .c_row = c.row_stride,
                  .accumulate = accumulate});
}

template <class Real>
void gemm_at_b_add(View<const Real> a, View<const Real> b, View<Real> c) {
  SEMFIELD_CHECK(a.rows == b.rows && a.cols == c.rows && b.cols == c.cols, "shapes of a matrix product do not fit");
  constexpr int kNarrow = 8;
  if (b.cols > kNarrow || a.cols < 2 * kNarrow) {
    gemm(Gemm<Real>{.m = a.cols,
                    .n = b.cols,
                    .k = a.rows,
                    .a = a.data,
                    .a_row = 1,
                    .a_col = a.row_stride,
                    .b = b.data,
                    .b_row = b.row_stride,
                    .c = c.data,
                    .c_row = c.row_stride,
                    .accumulate = true});
    return;
  }
  // Few columns: C^T += B^T A fills whole vectors along A's columns. The same chain of products, so the same bits.
  constexpr std::int32_t kStrip = 64;
  Real strip[kNarrow * kStrip];
  for (std::int32_t first = 0; first < a.cols; first += kStrip) {
    const std::int32_t count = std::min(kStrip, a.cols - first);
    for (std::int32_t i = 0; i < count; ++i) {
      for (std::int32_t j = 0; j < b.cols; ++j) strip[j * kStrip + i] = c(first + i, j);
    }
    gemm(Gemm<Real>{.m = b.cols,
                    .n = count,
                    .k = a.rows,
                    .a = b.data,
                    .a_row = 1,
                    .a_col = b.row_stride,
                    .b = a.data + first,
                    .b_row = a.row_stride,
                    .c = strip,
                    .c_row = kStrip,
                    .accumulate = true});
    for (std::int32_t i = 0; i < count; ++i) {
      for (std::int32_t j = 0; j < b.cols; ++j) c(first + i, j) = strip[j * kStrip + i];
    }
  }
}

template void gemm<float>(const Gemm<float>&);
template void gemm<double>(const Gemm<double>&);
template void gemm<float>(View<const float>, View<const float>, View<float>, bool);
template void gemm<double>(View<const double>, View<const double>, View<double>, bool);
template void gemm_at_b_add<float>(View<const float>, View<const float>, View<float>);
template void gemm_at_b_add<double>(View<const double>, View<const double>, View<double>);

}  // namespace semfield
