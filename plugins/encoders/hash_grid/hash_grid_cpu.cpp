// CPU kernels of the hash grid: 16 samples at a time, a level for all rows of a call, so that its table is in cache.
#if defined(__FMA__)
#include <immintrin.h>
#endif

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>

#include "compute/isa.h"
#include "compute/math_functions.h"
#include "compute/parallel.h"
#include "core/workspace.h"
#include "encoders/hash_grid/hash_grid_kernels.h"
#include "plugin/kernels.h"

// Groups of 16 samples of one level: their vertices and weights, the gather and the scatter.

namespace semfield {
namespace {

/// Samples that are worked on together. The last group is filled up, never cut: every row goes through the same
/// instructions, so its bits do not depend on its place.
constexpr std::int32_t kLanes = 16;

/// The four edges along x of the cells in which kLanes samples lie. Edge e is the far one along y, z where bit 0, 1 of
/// e is set. Its far end needs no address arithmetic of its own: a dense level stores it behind the near end, and in a
/// hashed one the two addresses differ by the bits in which x and x + 1 differ.
template <class Real>
struct Edges {
  alignas(64) std::uint32_t near_entry[4][kLanes];  // a level has at most 2^24 entries
  alignas(64) std::uint32_t flip[kLanes];           // hashed levels: far entry = near entry ^ flip, never 0
  alignas(64) Real weight[4][kLanes];               // along y times along z
  alignas(64) Real far_weight[kLanes];              // along x
};

/// Cell and weight of the far vertex along each axis.
template <class Real>
struct AxisCells {
  alignas(64) std::uint32_t cell[3][kLanes];
  alignas(64) Real far[3][kLanes];
};

#if defined(__AVX512F__)
/// The operations of find_cells, so the same bits. All 48 coordinates are worked on as they lie; then 32-bit halves are
/// sorted by axis.
template <Interpolation kInterpolation>
inline void find_cells_avx512(const HashGridLevel& level, const double* x, AxisCells<float>& out) {
  const __m512d resolution = _mm512_set1_pd(static_cast<double>(level.resolution));
  const __m512d last = _mm512_sub_pd(resolution, _mm512_set1_pd(1.0));
  __m512i cell[3];
  __m512 place[3];
  for (int k = 0; k < 3; ++k) {
    __m256i cells[2];
    __m256 places[2];
    for (int h = 0; h < 2; ++h) {
      const __m512d above = _mm512_max_pd(_mm512_loadu_pd(x + 16 * k + 8 * h), _mm512_setzero_pd());  // NaN becomes 0
      const __m512d p = _mm512_mul_pd(_mm512_min_pd(above, _mm512_set1_pd(1.0)), resolution);
      const __m512d at = _mm512_min_pd(_mm512_roundscale_pd(p, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC), last);
      cells[h] = _mm512_cvttpd_epi32(at);
      places[h] = _mm512_cvtpd_ps(_mm512_sub_pd(p, at));
    }
    cell[k] = _mm512_inserti64x4(_mm512_castsi256_si512(cells[0]), cells[1], 1);
    place[k] = _mm512_castpd_ps(
        _mm512_insertf64x4(_mm512_castps_pd(_mm512_castps256_ps512(places[0])), _mm256_castps_pd(places[1]), 1));
  }
  // Sample i's coordinate d is element 3 i + d of the 48. The first two registers hold samples up to 10 (d = 0, 1: 31 /
  // 3) or 9 (d = 2), the third the rest.
  for (int d = 0; d < 3; ++d) {
    const __m512i place_of = _mm512_add_epi32(
        _mm512_set1_epi32(d), _mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 33, 36, 39, 42, 45));
    const __mmask16 in_third = _mm512_cmpge_epi32_mask(place_of, _mm512_set1_epi32(32));
    const __m512i c = _mm512_permutex2var_epi32(cell[0], place_of, cell[1]);
    const __m512 w = _mm512_permutex2var_ps(place[0], place_of, place[1]);
    _mm512_store_si512(out.cell[d], _mm512_mask_permutexvar_epi32(c, in_third, place_of, cell[2]));
    __m512 far = _mm512_mask_permutexvar_ps(w, in_third, place_of, place[2]);
    if constexpr (kInterpolation == Interpolation::smoothstep) {
      far = _mm512_mul_ps(_mm512_mul_ps(far, far), _mm512_fnmadd_ps(_mm512_set1_ps(2.f), far, _mm512_set1_ps(3.f)));
    }
    _mm512_store_ps(out.far[d], far);
  }
}
#endif

/// Of kLanes samples, x [kLanes, 3] contiguous.
template <class Real, Interpolation kInterpolation>
inline void find_cells(const HashGridLevel& level, const double* x, AxisCells<Real>& out) {
#if defined(__AVX512F__)
  if constexpr (std::is_same_v<Real, float>) return find_cells_avx512<kInterpolation>(level, x, out);
#endif
  const auto resolution = static_cast<double>(level.resolution);
  for (int d = 0; d < 3; ++d) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const AxisCell<Real> at = axis_cell<Real>(clamp_unit(x[3 * i + d]), resolution);
      out.cell[d][i] = at.cell;
      out.far[d][i] = far_weight(at.place, kInterpolation);
    }
  }
}

/// Edges of kLanes samples, x [kLanes, 3] contiguous. No part of its callers, of which there are many.
template <class Real, bool kDense>
[[gnu::noinline]] void find_edges(const HashGridLevel& level, Interpolation interpolation, const double* x,
                                  Edges<Real>& out) {
  const auto vertices = static_cast<std::uint32_t>(level.resolution) + 1;
  const auto mask = static_cast<std::uint32_t>(level.entries) - 1;
  AxisCells<Real> at;
  interpolation == Interpolation::smoothstep ? find_cells<Real, Interpolation::smoothstep>(level, x, at)
                                             : find_cells<Real, Interpolation::linear>(level, x, at);
  for (std::int32_t i = 0; i < kLanes; ++i) {
    out.flip[i] = (at.cell[0][i] ^ (at.cell[0][i] + 1)) & mask;
    out.far_weight[i] = at.far[0][i];
  }
#pragma GCC unroll 4
  for (std::uint32_t e = 0; e < 4; ++e) {
    const std::uint32_t by = e & 1, bz = e >> 1;
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const std::uint32_t cx = at.cell[0][i], cy = at.cell[1][i] + by, cz = at.cell[2][i] + bz;
      out.near_entry[e][i] = kDense ? dense_index<std::uint32_t>(cx, cy, cz, vertices) : hash_index(cx, cy, cz, mask);
      const Real wy = by != 0 ? at.far[1][i] : Real(1) - at.far[1][i];
      const Real wz = bz != 0 ? at.far[2][i] : Real(1) - at.far[2][i];
      out.weight[e][i] = wy * wz;
    }
  }
}

template <class Real, bool kDense>
inline std::int64_t far_entry(const Edges<Real>& edges, int e, std::int64_t i) {
  return kDense ? edges.near_entry[e][i] + 1 : edges.near_entry[e][i] ^ edges.flip[i];
}

// The slopes of a level, in steps that each know at compile time only what they depend on: they compile much sooner.

/// Weights of the two ends along each axis, and the slope of the far one, of kLanes samples.
template <class Real>
struct AxisSlopes {
  alignas(64) Real weight[3][2][kLanes];
  alignas(64) Real slope[3][kLanes];
};

template <class Real, Interpolation kInterpolation>
[[gnu::noinline]] void find_slopes(Real resolution, const AxisCells<Real>& at, AxisSlopes<Real>& out) {
  for (int d = 0; d < 3; ++d) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const Real place = at.far[d][i];
      out.weight[d][1][i] = far_weight(place, kInterpolation);
      out.weight[d][0][i] = Real(1) - out.weight[d][1][i];
      out.slope[d][i] = resolution * far_weight_slope(place, kInterpolation);
    }
  }
}

/// The entry of each corner; bit d of a corner is set where it is the far one along axis d.
template <class Real, bool kDense>
[[gnu::noinline]] void find_corners(const HashGridLevel& level, const AxisCells<Real>& at,
                                    std::uint32_t (*entry)[kLanes]) {
  const auto vertices = static_cast<std::uint32_t>(level.resolution) + 1;
  const auto mask = static_cast<std::uint32_t>(level.entries) - 1;
  for (std::uint32_t c = 0; c < 8; ++c) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const std::uint32_t cx = at.cell[0][i] + (c & 1), cy = at.cell[1][i] + ((c >> 1) & 1),
                          cz = at.cell[2][i] + (c >> 2);
      entry[c][i] = kDense ? dense_index<std::uint32_t>(cx, cy, cz, vertices) : hash_index(cx, cy, cz, mask);
    }
  }
}

/// <dy, entry> of each corner, dy [F, kLanes].
template <class Real, std::int32_t kFeatures>
[[gnu::noinline]] void multiply_corners(const Real* table, const std::uint32_t (*entry)[kLanes],
                                        const Real (*dy)[kLanes], Real (*product)[kLanes]) {
  for (int c = 0; c < 8; ++c) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const Real* const values = table + static_cast<std::int64_t>(entry[c][i]) * kFeatures;
      Real sum = dy[0][i] * values[0];
      for (std::int32_t f = 1; f < kFeatures; ++f) sum = SEMFIELD_ISA::multiply_add(dy[f][i], values[f], sum);
      product[c][i] = sum;
    }
  }
}

/// slopes += N w'(place) times the other axes' weights times the product, over the corners in order.
template <class Real>
[[gnu::noinline]] void add_corners(const AxisSlopes<Real>& at, const Real (*product)[kLanes],
                                   double (*slopes)[kLanes]) {
  for (std::uint32_t c = 0; c < 8; ++c) {
    const std::uint32_t bit[3] = {c & 1, (c >> 1) & 1, c >> 2};
    for (int d = 0; d < 3; ++d) {
      const int e = (d + 1) % 3, g = (d + 2) % 3;
      for (std::int32_t i = 0; i < kLanes; ++i) {
        const Real factor = at.weight[e][bit[e]][i] * at.weight[g][bit[g]][i] * at.slope[d][i];
        const Real signed_factor = bit[d] != 0 ? factor : -factor;
        if constexpr (std::is_same_v<Real, double>) {
          slopes[d][i] = SEMFIELD_ISA::multiply_add(signed_factor, product[c][i], slopes[d][i]);
        } else {
          slopes[d][i] += signed_factor * product[c][i];
        }
      }
    }
  }
}

/// Two floats, the usual entry: both ends of an edge travel in one 128-bit register.
#if defined(__FMA__)
template <class Real, std::int32_t kFeatures>
inline constexpr bool kPairs = std::is_same_v<Real, float>&& kFeatures == 2;

template <bool kDense>
inline __m128 load_edge(const float* table, const Edges<float>& edges, int e, std::int64_t i) {
  const float* near = table + static_cast<std::int64_t>(edges.near_entry[e][i]) * 2;
  if constexpr (kDense) return _mm_loadu_ps(near);
  const __m128d low = _mm_load_sd(reinterpret_cast<const double*>(near));
  const float* far = table + far_entry<float, kDense>(edges, e, i) * 2;
  return _mm_castpd_ps(_mm_loadh_pd(low, reinterpret_cast<const double*>(far)));
}
template <bool kDense>
inline void store_edge(float* table, const Edges<float>& edges, int e, std::int64_t i, __m128 v) {
  float* near = table + static_cast<std::int64_t>(edges.near_entry[e][i]) * 2;
  if constexpr (kDense) {
    _mm_storeu_ps(near, v);
    return;
  }
  _mm_storel_pd(reinterpret_cast<double*>(near), _mm_castps_pd(v));
  _mm_storeh_pd(reinterpret_cast<double*>(table + far_entry<float, kDense>(edges, e, i) * 2), _mm_castps_pd(v));
}
#endif

/// out [kLanes, F]: the entries of sample i's edges, summed in order with their weights, then interpolated along x.
template <class Real, std::int32_t kFeatures, bool kDense>
inline void interpolate(const Edges<Real>& edges, const Real* table, Real* out) {
#if defined(__FMA__)
  if constexpr (kPairs<Real, kFeatures>) {
    for (std::int64_t i = 0; i < kLanes; ++i) {
      __m128 sum = _mm_mul_ps(_mm_set1_ps(edges.weight[0][i]), load_edge<kDense>(table, edges, 0, i));
#pragma GCC unroll 3
      for (int e = 1; e < 4; ++e) {
        sum = _mm_fmadd_ps(_mm_set1_ps(edges.weight[e][i]), load_edge<kDense>(table, edges, e, i), sum);
      }
      const __m128 step = _mm_sub_ps(_mm_movehl_ps(sum, sum), sum);
      const __m128 y = _mm_fmadd_ps(_mm_set1_ps(edges.far_weight[i]), step, sum);
      _mm_storel_pd(reinterpret_cast<double*>(out + i * kFeatures), _mm_castps_pd(y));
    }
    return;
  }
#endif
  for (std::int64_t i = 0; i < kLanes; ++i) {
    Real near[kFeatures] = {}, far[kFeatures] = {};
    for (int e = 0; e < 4; ++e) {
      const Real* a = table + static_cast<std::int64_t>(edges.near_entry[e][i]) * kFeatures;
      const Real* b = table + far_entry<Real, kDense>(edges, e, i) * kFeatures;
      const Real w = edges.weight[e][i];
      for (std::int32_t f = 0; f < kFeatures; ++f) {
        near[f] += w * a[f];
        far[f] += w * b[f];
      }
    }
    for (std::int32_t f = 0; f < kFeatures; ++f)
      out[i * kFeatures + f] = near[f] + edges.far_weight[i] * (far[f] - near[f]);
  }
}

/// The entries of sample i's edges += their weights dy[i], dy [kLanes, F]; the first n samples, in order.
template <class Real, std::int32_t kFeatures, bool kDense>
inline void scatter(const Edges<Real>& edges, Real* grad, std::int64_t n, const Real* dy) {
#if defined(__FMA__)
  if constexpr (kPairs<Real, kFeatures>) {
    for (std::int64_t i = 0; i < n; ++i) {
      const __m128 d = _mm_castpd_ps(_mm_loaddup_pd(reinterpret_cast<const double*>(dy + i * kFeatures)));
      const __m128 far = _mm_mul_ps(_mm_set1_ps(edges.far_weight[i]), d);
      const __m128 both = _mm_shuffle_ps(_mm_sub_ps(d, far), far, _MM_SHUFFLE(1, 0, 1, 0));
#pragma GCC unroll 4
      for (int e = 0; e < 4; ++e) {
        store_edge<kDense>(grad, edges, e, i,
                           _mm_fmadd_ps(_mm_set1_ps(edges.weight[e][i]), both, load_edge<kDense>(grad, edges, e, i)));
      }
    }
    return;
  }
#endif
  for (std::int64_t i = 0; i < n; ++i) {
    Real near[kFeatures], far[kFeatures];
    for (std::int32_t f = 0; f < kFeatures; ++f) {
      far[f] = edges.far_weight[i] * dy[i * kFeatures + f];
      near[f] = dy[i * kFeatures + f] - far[f];
    }
    for (int e = 0; e < 4; ++e) {
      Real* a = grad + static_cast<std::int64_t>(edges.near_entry[e][i]) * kFeatures;
      Real* b = grad + far_entry<Real, kDense>(edges, e, i) * kFeatures;
      const Real w = edges.weight[e][i];
      for (std::int32_t f = 0; f < kFeatures; ++f) {
        a[f] += w * near[f];
        b[f] += w * far[f];
      }
    }
  }
}

}  // namespace
}  // namespace semfield

namespace semfield::SEMFIELD_ISA {

namespace {

constexpr std::int64_t kBlockRows = 49152;  // a level is finished for so many rows before its table is left
constexpr std::int64_t kPieceRows = 4096;   // of a level's forward that a thread takes at a time; whole groups
constexpr std::int64_t kCopyRows = 1024;
constexpr std::int64_t kInputTaskRows = 256;

/// Calls f with the level's compile-time choices: (features, dense).
template <class F>
void with_kind(const HashGridLevel& level, std::int32_t features, const F& f) {
  with_features(features, [&]<std::int32_t kFeatures>() {
    level.dense ? f.template operator()<kFeatures, true>() : f.template operator()<kFeatures, false>();
  });
}

void keep_least(std::atomic<std::int64_t>& least, std::int64_t value) {
  std::int64_t known = least;
  while (value < known && !least.compare_exchange_weak(known, value)) {
  }
}

std::int64_t first_bad_row(View<const double> x) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    if (!std::isfinite(x(r, 0)) || !std::isfinite(x(r, 1)) || !std::isfinite(x(r, 2))) return r;
  }
  return -1;
}

/// kLanes rows of x from row r on, contiguous; rows behind the last one are 0.
class RowReader {
 public:
  explicit RowReader(View<const double> x) : x_(x) {}
  const double* at(std::int64_t r) {
    if (x_.row_stride == 3 && r + kLanes <= x_.rows) return x_.row(r);
    for (std::int64_t i = 0; i < kLanes; ++i) {
      for (int d = 0; d < 3; ++d) copy_[3 * i + d] = r + i < x_.rows ? x_(r + i, d) : 0.0;
    }
    return copy_;
  }

 private:
  View<const double> x_;
  alignas(64) double copy_[3 * kLanes];
};

/// Reads a table in order, a load a cache line, when so many rows are to come that most of its lines will be used: the
/// hardware fetches a stream several times as fast as single lines.
template <class Real>
void warm(const Real* table, std::int64_t values, std::int64_t rows) {
  constexpr std::int64_t kLine = 64 / static_cast<std::int64_t>(sizeof(Real));
  if (4 * rows < values / kLine) return;
  for (std::int64_t i = 0; i < values; i += kLine) {
    asm volatile("" : : "r"(static_cast<const volatile Real*>(table)[i]));
  }
}

/// Calls f(edges, first row) for each group of rows of x. Edges are found one group ahead: by the time they are read
/// they have left the store buffer.
template <class Real, bool kDense, class F>
void for_groups(const HashGridLevel& level, Interpolation interpolation, View<const double> x, const F& f) {
  Edges<Real> edges[2];
  RowReader rows(x);
  find_edges<Real, kDense>(level, interpolation, rows.at(0), edges[0]);
  int now = 0;
  for (std::int64_t r = 0; r < x.rows; r += kLanes, now ^= 1) {
    const std::int64_t next = r + kLanes;
    if (next < x.rows) find_edges<Real, kDense>(level, interpolation, rows.at(next), edges[now ^ 1]);
    f(edges[now], r);
  }
}

/// Values of a block of rows, level by level: level l's are [rows, F] from value(l) on. Kernels read and write them as
/// a stream, where a level's share of a row of y would cost a cache line a row.
template <class Real>
struct Columns {
  Real* data;
  std::int64_t stride;  // elements between levels

  /// Whole groups of rows, and a little more: columns a power of two apart would fall on the same sets of the cache.
  Columns(Workspace& workspace, const HashGridShape& shape, std::int64_t all_rows)
      : stride(((std::min(kBlockRows, all_rows) + kLanes - 1) / kLanes * kLanes + 40) * shape.features) {
    data = workspace.take<Real>(shape.levels, static_cast<std::int32_t>(stride)).data;
  }
  Real* value(std::int32_t level) const { return data + level * stride; }
};

/// Between columns and rows of y, over every thread.
template <class Real, bool kToRows, class Row>
void transpose(const HashGridShape& shape, const Columns<Real>& columns, View<Row> y) {
  parallel_for((y.rows + kCopyRows - 1) / kCopyRows, [&](std::int64_t task) {
    with_features(shape.features, [&]<std::int32_t kF>() {
      const std::int64_t end = std::min(y.rows, (task + 1) * kCopyRows);
      for (std::int64_t r = task * kCopyRows; r < end; ++r) {
        for (std::int32_t l = 0; l < shape.levels; ++l) {
          Real* const column = columns.value(l) + r * kF;
          if constexpr (kToRows) {
            std::memcpy(y.row(r) + l * kF, column, sizeof(Real) * kF);
          } else {
            std::memcpy(column, y.row(r) + l * kF, sizeof(Real) * kF);
          }
        }
      }
    });
  });
}

/// f(level, piece, whether the thread begins with the level) for every piece of every level. Threads begin apart from
/// each other, the finest level first, and stay with a level, whose table they then have in cache, while it has pieces.
template <class F>
void for_level_pieces(std::int32_t levels, std::int64_t pieces, const F& f) {
  if (pieces == 1)
    return parallel_for(levels, [&](std::int64_t i) { f(static_cast<std::int32_t>(levels - 1 - i), 0, true); });
  struct alignas(64) Next {
    std::atomic<std::int64_t> piece{0};
  } next[kHashGridMaxLevels];
  const std::int64_t workers = std::min<std::int64_t>(thread_count(), levels * pieces);
  parallel_for(workers, [&](std::int64_t worker) {
    const std::int64_t first = worker * levels / workers;
    for (std::int64_t k = 0; k < levels; ++k) {
      const auto level = static_cast<std::int32_t>(levels - 1 - (first + k) % levels);
      std::atomic<std::int64_t>& piece = next[level].piece;
      bool begins = true;
      for (std::int64_t p = piece++; p < pieces; p = piece++, begins = false) f(level, p, begins);
    }
  });
}

template <class Real>
std::int64_t forward(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<Real> y,
                     Workspace& workspace) {
  const Workspace::Scope scope(workspace);
  const Columns<Real> columns(workspace, shape, x.rows);
  constexpr std::int64_t kNone = std::numeric_limits<std::int64_t>::max();
  std::atomic<std::int64_t> bad{kNone};
  for (std::int64_t begin = 0; begin < x.rows && bad == kNone; begin += kBlockRows) {
    const std::int64_t rows = std::min(kBlockRows, x.rows - begin);
    for_level_pieces(
        shape.levels, (rows + kPieceRows - 1) / kPieceRows, [&](std::int32_t l, std::int64_t p, bool begins) {
          const std::int64_t at = p * kPieceRows;
          const View<const double> piece = x.row_range(begin + at, std::min(kPieceRows, rows - at));
          if (l == 0) {
            if (const std::int64_t row = first_bad_row(piece); row >= 0) keep_least(bad, begin + at + row);
          }
          const HashGridLevel& level = shape.level[l];
          const Real* const table = tables[l].data;
          Real* const column = columns.value(l) + at * shape.features;
          if (begins) warm(table, level.entries * shape.features, rows);
          with_kind(level, shape.features, [&]<std::int32_t kF, bool kDense>() {
            for_groups<Real, kDense>(level, shape.interpolation, piece, [&](const Edges<Real>& edges, std::int64_t r) {
              interpolate<Real, kF, kDense>(edges, table, column + r * kF);
            });
          });
        });
    transpose<Real, true>(shape, columns, y.row_range(begin, rows));
  }
  return bad == kNone ? -1 : bad.load();
}

/// d table[v] += w_v dy, a level in one thread, rows in order.
template <class Real>
void backward_tables(const HashGridShape& shape, const View<Real>* grads, View<const double> x, View<const Real> dy,
                     Workspace& workspace) {
  const Workspace::Scope scope(workspace);
  const Columns<Real> columns(workspace, shape, x.rows);
  for (std::int64_t begin = 0; begin < x.rows; begin += kBlockRows) {
    const std::int64_t rows = std::min(kBlockRows, x.rows - begin);
    const View<const double> block = x.row_range(begin, rows);
    transpose<Real, false>(shape, columns, dy.row_range(begin, rows));
    // Finest first: the dear levels start early and the cheap coarse ones fill the gaps.
    parallel_for(shape.levels, [&](std::int64_t i) {
      const auto l = static_cast<std::int32_t>(shape.levels - 1 - i);
      const HashGridLevel& level = shape.level[l];
      Real* const grad = grads[l].data;
      warm(grad, level.entries * shape.features, rows);
      with_kind(level, shape.features, [&]<std::int32_t kF, bool kDense>() {
        for_groups<Real, kDense>(level, shape.interpolation, block, [&](const Edges<Real>& edges, std::int64_t r) {
          scatter<Real, kF, kDense>(edges, grad, std::min<std::int64_t>(kLanes, rows - r), columns.value(l) + r * kF);
        });
      });
    });
  }
}

/// dx of at most kInputTaskRows rows, a level for all of them at a time; 0 along an axis on which a row was clamped.
template <class Real>
void input_gradient(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<const Real> dy,
                    View<Real> dx) {
  double slopes[kInputTaskRows / kLanes][3][kLanes] = {};
  RowReader rows(x);
  for (std::int32_t l = 0; l < shape.levels; ++l) {
    const HashGridLevel& level = shape.level[l];
    with_kind(level, shape.features, [&]<std::int32_t kF, bool kDense>() {
      for (std::int64_t r = 0; r < x.rows; r += kLanes) {
        alignas(64) Real gradient[kF][kLanes];
        for (std::int64_t i = 0; i < kLanes; ++i) {
          for (std::int32_t f = 0; f < kF; ++f) gradient[f][i] = r + i < x.rows ? dy(r + i, l * kF + f) : Real(0);
        }
        AxisCells<Real> cells;
        find_cells<Real, Interpolation::linear>(level, rows.at(r), cells);  // so that far is the place
        AxisSlopes<Real> at;
        const auto resolution = static_cast<Real>(level.resolution);
        shape.interpolation == Interpolation::smoothstep
            ? find_slopes<Real, Interpolation::smoothstep>(resolution, cells, at)
            : find_slopes<Real, Interpolation::linear>(resolution, cells, at);
        alignas(64) std::uint32_t entry[8][kLanes];
        find_corners<Real, kDense>(level, cells, entry);
        alignas(64) Real product[8][kLanes];
        multiply_corners<Real, kF>(tables[l].data, entry, gradient, product);
        add_corners<Real>(at, product, slopes[r / kLanes]);
      }
    });
  }
  for (std::int64_t r = 0; r < x.rows; ++r) {
    for (std::int32_t d = 0; d < 3; ++d) {
      const bool inside = x(r, d) >= 0 && x(r, d) <= 1;
      dx(r, d) = inside ? static_cast<Real>(slopes[r / kLanes][d][r % kLanes]) : Real(0);
    }
  }
}

template <class Real>
void backward_input(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<const Real> dy,
                    View<Real> dx) {
  parallel_for((x.rows + kInputTaskRows - 1) / kInputTaskRows, [&](std::int64_t task) {
    const std::int64_t begin = task * kInputTaskRows, rows = std::min(kInputTaskRows, x.rows - begin);
    input_gradient<Real>(shape, tables, x.row_range(begin, rows), dy.row_range(begin, rows), dx.row_range(begin, rows));
  });
}

template <class Real>
const HashGridKernels<Real> kTable{forward<Real>, backward_tables<Real>, backward_input<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(hash_grid, "encoder 'hash_grid'", kTable)

}  // namespace semfield::SEMFIELD_ISA
