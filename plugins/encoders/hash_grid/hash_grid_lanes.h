// Groups of 16 samples of one level: their vertices and weights, the gather and the scatter.
#pragma once

#if defined(__FMA__)
#include <immintrin.h>
#endif

#include <cstdint>
#include <type_traits>

#include "compute/math_functions.h"
#include "encoders/hash_grid/hash_grid_kernels.h"

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

template <class Real, Interpolation kInterpolation>
inline void find_cells_by_axis(const HashGridLevel& level, const double* x, AxisCells<Real>& out) {
  const auto resolution = static_cast<double>(level.resolution);
  for (int d = 0; d < 3; ++d) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const AxisCell<Real> at = axis_cell<Real>(clamp_unit(x[3 * i + d]), resolution);
      out.cell[d][i] = at.cell;
      out.far[d][i] = far_weight(at.place, kInterpolation);
    }
  }
}

#if defined(__AVX512F__)
/// The same operations, so the same bits. All 48 coordinates are worked on as they lie; then 32-bit halves are sorted
/// by axis.
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
  if constexpr (std::is_same_v<Real, float>) {
    find_cells_avx512<kInterpolation>(level, x, out);
  } else {
    find_cells_by_axis<Real, kInterpolation>(level, x, out);
  }
#else
  find_cells_by_axis<Real, kInterpolation>(level, x, out);
#endif
}

/// Edges of kLanes samples, x [kLanes, 3] contiguous.
template <class Real, bool kDense, Interpolation kInterpolation>
inline void find_edges(const HashGridLevel& level, const double* x, Edges<Real>& out) {
  const auto vertices = static_cast<std::uint32_t>(level.resolution) + 1;
  const auto mask = static_cast<std::uint32_t>(level.entries) - 1;
  AxisCells<Real> at;
  find_cells<Real, kInterpolation>(level, x, at);
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

/// slopes += dy times the slope of kLanes samples along each axis, x [kLanes, 3] contiguous, dy [F, kLanes]: the sum
/// over the corners of N w'(place) times the other axes' weights times <dy, entry>.
template <class Real, std::int32_t kFeatures, bool kDense, Interpolation kInterpolation>
inline void add_slopes(const HashGridLevel& level, const Real* table, const double* x, const Real (*dy)[kLanes],
                       double (*slopes)[kLanes]) {
  const auto vertices = static_cast<std::uint32_t>(level.resolution) + 1;
  const auto mask = static_cast<std::uint32_t>(level.entries) - 1;
  const auto resolution = static_cast<Real>(level.resolution);
  AxisCells<Real> at;
  find_cells<Real, Interpolation::linear>(level, x, at);  // so that far is the place
  alignas(64) Real weight[3][2][kLanes], slope[3][kLanes];
  for (int d = 0; d < 3; ++d) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const Real place = at.far[d][i];
      weight[d][1][i] = far_weight(place, kInterpolation);
      weight[d][0][i] = Real(1) - weight[d][1][i];
      slope[d][i] = resolution * far_weight_slope(place, kInterpolation);
    }
  }
#pragma GCC unroll 8
  for (std::uint32_t c = 0; c < 8; ++c) {
    const std::uint32_t bit[3] = {c & 1, (c >> 1) & 1, c >> 2};
    alignas(64) std::uint32_t entry[kLanes];
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const std::uint32_t cx = at.cell[0][i] + bit[0], cy = at.cell[1][i] + bit[1], cz = at.cell[2][i] + bit[2];
      entry[i] = kDense ? dense_index<std::uint32_t>(cx, cy, cz, vertices) : hash_index(cx, cy, cz, mask);
    }
    alignas(64) Real product[kLanes];
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const Real* const values = table + static_cast<std::int64_t>(entry[i]) * kFeatures;
      product[i] = dy[0][i] * values[0];
      for (std::int32_t f = 1; f < kFeatures; ++f)
        product[i] = SEMFIELD_ISA::multiply_add(dy[f][i], values[f], product[i]);
    }
#pragma GCC unroll 3
    for (int d = 0; d < 3; ++d) {
      const int e = (d + 1) % 3, g = (d + 2) % 3;
      for (std::int32_t i = 0; i < kLanes; ++i) {
        const Real factor = weight[e][bit[e]][i] * weight[g][bit[g]][i] * slope[d][i];
        const Real signed_factor = bit[d] != 0 ? factor : -factor;
        if constexpr (std::is_same_v<Real, double>) {
          slopes[d][i] = SEMFIELD_ISA::multiply_add(signed_factor, product[i], slopes[d][i]);
        } else {
          slopes[d][i] += signed_factor * product[i];
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
