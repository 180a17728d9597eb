// What the CUDA kernels of the hash grid share: levels as kernel arguments, cells, entries and compile-time choices.
#pragma once

#include <cstdint>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "encoders/hash_grid/hash_grid_kernels.h"

namespace semfield::cuda {

/// A level's table (or its gradient) with what its entries' numbers are made of: x + y_step y + z_step z in a dense
/// level, (x ^ y_step y ^ z_step z) & mask in a hashed one.
struct GridLevel {
  float* table = nullptr;
  double resolution = 0;
  std::uint32_t entries = 0;
  std::uint32_t y_step = 0, z_step = 0;
  std::uint32_t mask = 0;
  bool dense = false;
};

/// A kernel argument: 40 bytes per level.
struct Grid {
  GridLevel level[kHashGridMaxLevels];
  std::int32_t levels = 0;
};

inline Grid make_grid(const HashGridShape& shape, const View<float>* tables) {
  Grid grid;
  grid.levels = shape.levels;
  for (std::int32_t l = 0; l < shape.levels; ++l) {
    const HashGridLevel& from = shape.level[l];
    GridLevel& to = grid.level[l];
    SEMFIELD_CHECK(reinterpret_cast<std::uintptr_t>(tables[l].data) % 16 == 0, "tables start on 16-byte boundaries");
    to.table = tables[l].data;
    to.resolution = static_cast<double>(from.resolution);
    to.entries = static_cast<std::uint32_t>(from.entries);
    to.mask = to.entries - 1;
    to.dense = from.dense;
    const auto vertices = static_cast<std::uint32_t>(from.resolution) + 1;
    to.y_step = from.dense ? dense_index<std::uint32_t>(0, 1, 0, vertices) : hash_index(0, 1, 0, ~0U);
    to.z_step = from.dense ? dense_index<std::uint32_t>(0, 0, 1, vertices) : hash_index(0, 0, 1, ~0U);
  }
  return grid;
}

/// The cell around a position: addends of its vertices' entries, near and far, and weights of the far ones.
struct Cell {
  std::uint32_t x;
  std::uint32_t y[2], z[2];
  float far[3];
};

/// u [3] in [0, 1].
template <Interpolation kI>
__device__ inline Cell find_cell(const GridLevel& level, const double (&u)[3]) {
  AxisCell<float> at[3];
  Cell cell;
#pragma unroll
  for (int d = 0; d < 3; ++d) {
    at[d] = axis_cell<float>(u[d], level.resolution);
    cell.far[d] = far_weight(at[d].place, kI);
  }
  cell.x = at[0].cell;
  cell.y[0] = at[1].cell * level.y_step;
  cell.y[1] = cell.y[0] + level.y_step;
  cell.z[0] = at[2].cell * level.z_step;
  cell.z[1] = cell.z[0] + level.z_step;
  return cell;
}

/// Both ends of edge e along x: the far one along y, z where bit 0, 1 of e is set.
struct Edge {
  std::uint32_t near, far;
};

__device__ inline Edge edge_of(const GridLevel& level, const Cell& cell, int e) {
  const std::uint32_t y = cell.y[e & 1], z = cell.z[e >> 1];
  const std::uint32_t sum = cell.x + y + z, mixed = (cell.x ^ y ^ z) & level.mask;
  const std::uint32_t far_mixed = ((cell.x + 1) ^ y ^ z) & level.mask;
  return level.dense ? Edge{sum, sum + 1} : Edge{mixed, far_mixed};
}

/// Weight of edge e: along y times along z.
__device__ inline float edge_weight(const Cell& cell, int e) {
  const float wy = (e & 1) != 0 ? cell.far[1] : 1.F - cell.far[1];
  const float wz = (e >> 1) != 0 ? cell.far[2] : 1.F - cell.far[2];
  return wy * wz;
}

/// True when rows of `view` can be read and written in 16-byte pieces.
template <class T>
inline bool rows_aligned(View<T> view) {
  return reinterpret_cast<std::uintptr_t>(view.data) % 16 == 0 && view.row_stride % 4 == 0;
}

/// Calls f with the compile-time choices (features, interpolation).
template <class F>
void with_kind(const HashGridShape& shape, const F& f) {
  const auto with_features = [&]<Interpolation kI>() {
    switch (shape.features) {
      case 1:
        return f.template operator()<1, kI>();
      case 2:
        return f.template operator()<2, kI>();
      case 4:
        return f.template operator()<4, kI>();
      default:
        return f.template operator()<8, kI>();
    }
  };
  if (shape.interpolation == Interpolation::smoothstep) {
    with_features.template operator()<Interpolation::smoothstep>();
  } else {
    with_features.template operator()<Interpolation::linear>();
  }
}

/// HashGridKernels::backward_tables.
void hash_grid_scatter(const HashGridShape& shape, const View<float>* grads, View<const double> x, View<const float> dy,
                       Workspace& workspace);

}  // namespace semfield::cuda
