// Groups of 16 samples of one level: their vertices and weights, the gather and the scatter.
#pragma once

#if defined(__FMA__)
#include <immintrin.h>
#endif

#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>

#include "core/view.h"
#include "encoders/hash_grid/hash_grid_kernels.h"

namespace semfield {

/// Samples that are worked on together. The last group of a tile is filled up, never cut: every row goes through the
/// same instructions, so its bits do not depend on its place.
inline constexpr std::int32_t kLanes = 16;

/// Clamped coordinates of up to kRows rows, axis by axis.
template <std::int64_t kRows>
struct UnitTile {
  alignas(64) double u[3][kRows + kLanes];

  /// False when a coordinate is not finite.
  bool load(View<const double> x, std::int64_t begin, std::int64_t rows) {
    std::int32_t bad = 0;
    for (std::int64_t r = 0; r < rows; ++r) {
      const double* from = x.row(begin + r);
      for (int d = 0; d < 3; ++d) {
        bad |= std::fabs(from[d]) <= std::numeric_limits<double>::max() ? 0 : 1;
        u[d][r] = clamp_unit(from[d]);
      }
    }
    for (std::int64_t r = rows; r < (rows + kLanes - 1) / kLanes * kLanes; ++r) u[0][r] = u[1][r] = u[2][r] = 0;
    return bad == 0;
  }
};

/// Corner c has the far vertex along x, y, z where bit 0, 1, 2 of c is set.
template <class Real>
struct Corners {
  alignas(64) std::uint32_t entry[8][kLanes];
  alignas(64) Real weight[8][kLanes];
};

/// Entry of a vertex. A dense level has at most 2^log2_entries <= 2^24 vertices, so 32 bits are enough here.
SEMFIELD_HD inline std::uint32_t vertex_entry(const HashGridLevel& level, std::uint32_t x, std::uint32_t y,
                                              std::uint32_t z) {
  return level.dense ? dense_index<std::uint32_t>(x, y, z, static_cast<std::uint32_t>(level.resolution) + 1)
                     : hash_index(x, y, z, static_cast<std::uint32_t>(level.entries) - 1);
}

template <class Real, bool kDense, Interpolation kInterpolation>
inline void find_corners(const HashGridLevel& level, const double* ux, const double* uy, const double* uz,
                         Corners<Real>& out) {
  const auto resolution = static_cast<double>(level.resolution);
  const HashGridLevel kind{level.resolution, level.entries,
                           kDense};  // lets the compiler fold the branch in vertex_entry
  const double* u[3] = {ux, uy, uz};
  alignas(64) std::uint32_t cell[3][kLanes];
  alignas(64) Real far[3][kLanes];
  for (int d = 0; d < 3; ++d) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      const AxisCell<Real> at = axis_cell<Real>(u[d][i], resolution);
      cell[d][i] = at.cell;
      far[d][i] = far_weight(at.place, kInterpolation);
    }
  }
  for (std::uint32_t c = 0; c < 8; ++c) {
    const std::uint32_t bx = c & 1, by = (c >> 1) & 1, bz = c >> 2;
    for (std::int32_t i = 0; i < kLanes; ++i) {
      out.entry[c][i] = vertex_entry(kind, cell[0][i] + bx, cell[1][i] + by, cell[2][i] + bz);
      const Real wx = bx != 0 ? far[0][i] : Real(1) - far[0][i];
      const Real wy = by != 0 ? far[1][i] : Real(1) - far[1][i];
      const Real wz = bz != 0 ? far[2][i] : Real(1) - far[2][i];
      out.weight[c][i] = wx * wy * wz;
    }
  }
}

/// Asks for the entries' cache lines. The far vertex along x is almost always in its neighbour's line, so half the
/// corners do.
template <class Real, std::int32_t kFeatures>
inline void prefetch(const Corners<Real>& corners, const Real* table) {
  for (int c = 0; c < 8; c += 2) {
    for (std::int32_t i = 0; i < kLanes; ++i) {
      __builtin_prefetch(table + static_cast<std::int64_t>(corners.entry[c][i]) * kFeatures);
    }
  }
}

/// Two floats, the usual entry, travel as one 64-bit word. The same fused multiply-adds as the plain loops, so the same
/// bits.
#if defined(__FMA__)
template <class Real, std::int32_t kFeatures>
inline constexpr bool kPairs = std::is_same_v<Real, float>&& kFeatures == 2;
inline __m128 load_pair(const float* p) {
  return _mm_castsi128_ps(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(p)));
}
inline void store_pair(float* p, __m128 v) { _mm_storel_epi64(reinterpret_cast<__m128i*>(p), _mm_castps_si128(v)); }
#endif

/// out[i] = sum_c weight_c[i] table[entry_c[i]] for the first n samples, corners in order.
template <class Real, std::int32_t kFeatures>
inline void interpolate(const Corners<Real>& corners, const Real* table, std::int64_t n, Real* out,
                        std::int64_t stride) {
#if defined(__FMA__)
  if constexpr (kPairs<Real, kFeatures>) {
    for (std::int64_t i = 0; i < n; ++i) {
      __m128 sum = _mm_setzero_ps();
#pragma GCC unroll 8
      for (int c = 0; c < 8; ++c) {
        const __m128 entry = load_pair(table + static_cast<std::int64_t>(corners.entry[c][i]) * kFeatures);
        sum = _mm_fmadd_ps(_mm_set1_ps(corners.weight[c][i]), entry, sum);
      }
      store_pair(out + i * stride, sum);
    }
    return;
  }
#endif
  for (std::int64_t i = 0; i < n; ++i) {
    Real sum[kFeatures] = {};
    for (int c = 0; c < 8; ++c) {
      const Real* entry = table + static_cast<std::int64_t>(corners.entry[c][i]) * kFeatures;
      const Real w = corners.weight[c][i];
      for (std::int32_t f = 0; f < kFeatures; ++f) sum[f] += w * entry[f];
    }
    for (std::int32_t f = 0; f < kFeatures; ++f) out[i * stride + f] = sum[f];
  }
}

/// grad[entry_c[i]] += weight_c[i] dy[i] for the first n samples, in order.
template <class Real, std::int32_t kFeatures>
inline void scatter(const Corners<Real>& corners, Real* grad, std::int64_t n, const Real* dy, std::int64_t stride) {
#if defined(__FMA__)
  if constexpr (kPairs<Real, kFeatures>) {
    for (std::int64_t i = 0; i < n; ++i) {
      const __m128 d = load_pair(dy + i * stride);
#pragma GCC unroll 8
      for (int c = 0; c < 8; ++c) {
        float* entry = grad + static_cast<std::int64_t>(corners.entry[c][i]) * kFeatures;
        store_pair(entry, _mm_fmadd_ps(_mm_set1_ps(corners.weight[c][i]), d, load_pair(entry)));
      }
    }
    return;
  }
#endif
  for (std::int64_t i = 0; i < n; ++i) {
    Real d[kFeatures];
    for (std::int32_t f = 0; f < kFeatures; ++f) d[f] = dy[i * stride + f];
    for (int c = 0; c < 8; ++c) {
      Real* entry = grad + static_cast<std::int64_t>(corners.entry[c][i]) * kFeatures;
      const Real w = corners.weight[c][i];
      for (std::int32_t f = 0; f < kFeatures; ++f) entry[f] += w * d[f];
    }
  }
}

}  // namespace semfield
