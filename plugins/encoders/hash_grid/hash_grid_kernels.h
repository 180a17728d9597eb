// Arguments and kernel table of the hash grid.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/view.h"
#include "plugin/row_encoder.h"

namespace semfield {

/// Weight of the far vertex along an axis: w itself, or w^2 (3 - 2w), whose slope is 0 on cell borders [Mueller22 App.
/// A].
enum class Interpolation : std::uint8_t { linear, smoothstep };

/// Cells along an axis at `level`: floor(base b^level), b = (finest / base)^(1 / (levels - 1)) [Mueller22 Eq. 2, 3].
/// The tiny factor keeps the last level at `finest` and whole powers whole, whatever the library's exp rounds to.
inline std::int64_t level_resolution(std::int64_t base, std::int64_t finest, int level, int levels) {
  if (levels <= 1) return base;
  const double growth = std::log(static_cast<double>(finest) / static_cast<double>(base)) / (levels - 1);
  return static_cast<std::int64_t>(std::floor(static_cast<double>(base) * std::exp(growth * level) * (1 + 1e-12)));
}

/// Vertices of a grid with `resolution` cells along each axis, (N + 1)^3: exact in 64 bits up to N = 2^21 - 2.
SEMFIELD_HD inline std::uint64_t vertex_count(std::int64_t resolution) {
  const auto n = static_cast<std::uint64_t>(resolution) + 1;
  return n * n * n;
}

/// Entry of vertex (x, y, z) of a dense level, x fastest. Index is 64-bit where the grid may exceed 2^32 vertices
/// (N >= 1625), 32-bit where the caller knows that it does not.
template <class Index>
SEMFIELD_HD inline Index dense_index(Index x, Index y, Index z, Index vertices_per_axis) {
  return x + vertices_per_axis * (y + vertices_per_axis * z);
}

/// Entry of vertex (x, y, z) of a hashed level, mask = entries - 1, entries a power of two [Mueller22 Eq. 4].
SEMFIELD_HD inline std::uint32_t hash_index(std::uint32_t x, std::uint32_t y, std::uint32_t z, std::uint32_t mask) {
  return (x ^ (y * 2654435761u) ^ (z * 805459861u)) & mask;
}

/// Cell and place within it along one axis.
template <class Real>
struct AxisCell {
  std::uint32_t cell;
  Real place;  // 0..1 from the near vertex to the far one
};

/// u in [0, 1]; the far face belongs to the last cell (place 1), so vertex `resolution` is the largest ever used. The
/// difference is taken in float64 and is exact.
template <class Real>
SEMFIELD_HD inline AxisCell<Real> axis_cell(double u, double resolution) {
  const double p = u * resolution;
  const double whole = std::floor(p);
  const double last = resolution - 1;
  const double cell = whole < last ? whole : last;
  return {static_cast<std::uint32_t>(static_cast<std::int32_t>(cell)), static_cast<Real>(p - cell)};
}

/// Weight of the far vertex and its slope.
template <class Real>
SEMFIELD_HD inline Real far_weight(Real w, Interpolation interpolation) {
  return interpolation == Interpolation::smoothstep ? w * w * (Real(3) - Real(2) * w) : w;
}
template <class Real>
SEMFIELD_HD inline Real far_weight_slope(Real w, Interpolation interpolation) {
  return interpolation == Interpolation::smoothstep ? Real(6) * w * (Real(1) - w) : Real(1);
}

inline constexpr std::int32_t kHashGridMaxLevels = 32;
inline constexpr std::int32_t kHashGridMaxFeatures = 8;

/// Calls f with the number of features known to the compiler.
template <class F>
void with_features(std::int32_t features, const F& f) {
  switch (features) {
    case 1:
      return f.template operator()<1>();
    case 2:
      return f.template operator()<2>();
    case 4:
      return f.template operator()<4>();
    default:
      return f.template operator()<8>();
  }
}

struct HashGridLevel {
  std::int64_t resolution = 0;  ///< cells along an axis, N
  std::int64_t entries = 0;     ///< rows of the level's tensor: (N + 1)^3 when dense, else a power of two
  bool dense = false;
};

struct HashGridShape {
  HashGridLevel level[kHashGridMaxLevels];
  std::int32_t levels = 0;
  std::int32_t features = 0;  ///< 1, 2, 4 or 8
  Interpolation interpolation = Interpolation::linear;
};

template <class Real>
struct HashGridKernels {
  /// y [M, levels * features] from x [M, 3] and one table a level. Returns the first row that is not finite, or -1.
  /// Parallel over levels and rows where the caller is not. Scratch: the columns of a block of rows.
  std::int64_t (*forward)(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<Real> y,
                          Workspace& workspace) = nullptr;
  /// grads += dL/dtables. CPU: one thread per level, rows in order, so any thread count gives the same bits; scratch as
  /// forward. CUDA: in any order without scratch, or with launch().deterministic in fixed point: the same bits every
  /// time, with 8 bytes of scratch an entry and feature of the largest 8 / F neighbouring levels.
  void (*backward_tables)(const HashGridShape& shape, const View<Real>* grads, View<const double> x,
                          View<const Real> dy, Workspace& workspace) = nullptr;
  /// dx = dL/dx [M, 3]; parallel over blocks of rows.
  void (*backward_input)(const HashGridShape& shape, const View<Real>* tables, View<const double> x,
                         View<const Real> dy, View<Real> dx) = nullptr;
};

void hash_grid_kernels(KernelTables& tables);

}  // namespace semfield
