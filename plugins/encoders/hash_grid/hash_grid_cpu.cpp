// CPU kernels of the hash grid: 16 samples at a time, level by level, so that one level's table is in cache.
#include <algorithm>
#include <cmath>
#include <limits>

#include "core/isa.h"
#include "core/parallel.h"
#include "encoders/hash_grid/hash_grid_kernels.h"
#include "encoders/hash_grid/hash_grid_lanes.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

void hash_grid_cpu_kernels(KernelTables& tables);

namespace {

constexpr std::int64_t kTileRows = 1024;  // 24 KB of clamped coordinates
constexpr std::int64_t kBlockRows =
    8192;  // forward finishes a level for so many rows before it turns to the next table
constexpr std::int64_t kPrefetchBytes = std::int64_t{1}
                                        << 18;  // larger tables do not fit beside the rest in the L2 cache
constexpr std::int64_t kInputTaskRows = 256;

/// Calls f with the level's compile-time choices: (features, dense, interpolation).
template <std::int32_t kFeatures, class F>
void with_level_kind(const HashGridLevel& level, Interpolation interpolation, const F& f) {
  if (interpolation == Interpolation::smoothstep) {
    if (level.dense) {
      f.template operator()<kFeatures, true, Interpolation::smoothstep>();
    } else {
      f.template operator()<kFeatures, false, Interpolation::smoothstep>();
    }
  } else {
    if (level.dense) {
      f.template operator()<kFeatures, true, Interpolation::linear>();
    } else {
      f.template operator()<kFeatures, false, Interpolation::linear>();
    }
  }
}
template <class F>
void with_kind(const HashGridLevel& level, std::int32_t features, Interpolation interpolation, const F& f) {
  switch (features) {
    case 1:
      with_level_kind<1>(level, interpolation, f);
      break;
    case 2:
      with_level_kind<2>(level, interpolation, f);
      break;
    case 4:
      with_level_kind<4>(level, interpolation, f);
      break;
    default:
      with_level_kind<8>(level, interpolation, f);
      break;
  }
}

std::int64_t first_bad_row(View<const double> x) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    if (!std::isfinite(x(r, 0)) || !std::isfinite(x(r, 1)) || !std::isfinite(x(r, 2))) return r;
  }
  return -1;
}

/// Calls f(corners, first row) for each group of the tile. Vertices are found, and their cache lines asked for, one
/// group ahead: a table that is not in the L2 cache answers while the group before is summed.
template <class Real, std::int32_t kFeatures, bool kDense, Interpolation kI, class Tile, class F>
void for_groups(const HashGridLevel& level, const Tile& tile, std::int64_t rows, const Real* table, const F& f) {
  Corners<Real> corners[2];
  find_corners<Real, kDense, kI>(level, tile.u[0], tile.u[1], tile.u[2], corners[0]);
  const bool far = level.entries * kFeatures * static_cast<std::int64_t>(sizeof(Real)) > kPrefetchBytes;
  int now = 0;
  for (std::int64_t r = 0; r < rows; r += kLanes, now ^= 1) {
    const std::int64_t next = r + kLanes;
    if (next < rows) {
      find_corners<Real, kDense, kI>(level, tile.u[0] + next, tile.u[1] + next, tile.u[2] + next, corners[now ^ 1]);
      if (far) prefetch<Real, kFeatures>(corners[now ^ 1], table);
    }
    f(corners[now], r);
  }
}

template <class Real>
std::int64_t forward(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<Real> y) {
  UnitTile<kTileRows> tile;
  for (std::int64_t block = 0; block < x.rows; block += kBlockRows) {
    const std::int64_t block_end = std::min(block + kBlockRows, x.rows);
    for (std::int32_t l = 0; l < shape.levels; ++l) {
      const HashGridLevel& level = shape.level[l];
      const Real* table = tables[l].data;
      for (std::int64_t begin = block; begin < block_end; begin += kTileRows) {
        const std::int64_t rows = std::min(kTileRows, block_end - begin);
        const bool loaded = l > 0 && block_end - block <= kTileRows;  // a single tile stays from level to level
        if (!loaded && !tile.load(x, begin, rows)) return first_bad_row(x);
        Real* out = y.row(begin) + l * shape.features;
        with_kind(level, shape.features, shape.interpolation, [&]<std::int32_t kF, bool kDense, Interpolation kI>() {
          for_groups<Real, kF, kDense, kI>(level, tile, rows, table, [&](const Corners<Real>& corners, std::int64_t r) {
            const std::int64_t n = std::min<std::int64_t>(kLanes, rows - r);
            interpolate<Real, kF>(corners, table, n, out + r * y.row_stride, y.row_stride);
          });
        });
      }
    }
  }
  return -1;
}

/// One level of the scatter: d table[v] += w_v dy, rows in order.
template <class Real>
void scatter_level(const HashGridShape& shape, std::int32_t l, Real* grad, View<const double> x, View<const Real> dy) {
  UnitTile<kTileRows> tile;
  const HashGridLevel& level = shape.level[l];
  with_kind(level, shape.features, shape.interpolation, [&]<std::int32_t kF, bool kDense, Interpolation kI>() {
    for (std::int64_t begin = 0; begin < x.rows; begin += kTileRows) {
      const std::int64_t rows = std::min(kTileRows, x.rows - begin);
      tile.load(x, begin, rows);
      const Real* from = dy.row(begin) + l * kF;
      for_groups<Real, kF, kDense, kI>(level, tile, rows, grad, [&](const Corners<Real>& corners, std::int64_t r) {
        const std::int64_t n = std::min<std::int64_t>(kLanes, rows - r);
        scatter<Real, kF>(corners, grad, n, from + r * dy.row_stride, dy.row_stride);
      });
    }
  });
}

template <class Real>
void backward_tables(const HashGridShape& shape, const View<Real>* grads, View<const double> x, View<const Real> dy) {
  struct Call {
    const HashGridShape& shape;
    const View<Real>* grads;
    View<const double> x;
    View<const Real> dy;
  };
  const Call call{shape, grads, x, dy};
  // Finest level first: the dear ones start early and the cheap coarse ones fill the gaps. One reference captured:
  // small enough for std::function's own storage, so nothing is allocated.
  parallel_for(shape.levels, [&call](std::int64_t i) {
    const auto l = static_cast<std::int32_t>(call.shape.levels - 1 - i);
    scatter_level<Real>(call.shape, l, call.grads[l].data, call.x, call.dy);
  });
}

/// Gradient of one row: sum over levels of N w'_d(place) times the other axes' weights times <dy, entry>; 0 along an
/// axis on which the row was clamped.
template <class Real>
void input_gradient(const HashGridShape& shape, const View<Real>* tables, const double* x, const Real* dy, Real* dx) {
  double sum[3] = {0, 0, 0};
  const std::int32_t features = shape.features;
  for (std::int32_t l = 0; l < shape.levels; ++l) {
    const HashGridLevel& level = shape.level[l];
    const auto resolution = static_cast<double>(level.resolution);
    std::uint32_t cell[3];
    Real weight[3][2], slope[3];
    for (int d = 0; d < 3; ++d) {
      const AxisCell<Real> at = axis_cell<Real>(clamp_unit(x[d]), resolution);
      cell[d] = at.cell;
      weight[d][1] = far_weight(at.place, shape.interpolation);
      weight[d][0] = Real(1) - weight[d][1];
      slope[d] = static_cast<Real>(resolution) * far_weight_slope(at.place, shape.interpolation);
    }
    for (std::uint32_t c = 0; c < 8; ++c) {
      const std::uint32_t bit[3] = {c & 1, (c >> 1) & 1, c >> 2};
      const Real* entry = tables[l].row(vertex_entry(level, cell[0] + bit[0], cell[1] + bit[1], cell[2] + bit[2]));
      Real product = 0;
      for (std::int32_t f = 0; f < features; ++f) product += dy[l * features + f] * entry[f];
      for (int d = 0; d < 3; ++d) {
        const int e = (d + 1) % 3, g = (d + 2) % 3;
        const Real other = weight[e][bit[e]] * weight[g][bit[g]] * slope[d] * product;
        sum[d] += bit[d] != 0 ? other : -other;
      }
    }
  }
  for (int d = 0; d < 3; ++d) dx[d] = x[d] >= 0 && x[d] <= 1 ? static_cast<Real>(sum[d]) : Real(0);
}

template <class Real>
void backward_input(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<const Real> dy,
                    View<Real> dx) {
  struct Call {
    const HashGridShape& shape;
    const View<Real>* tables;
    View<const double> x;
    View<const Real> dy;
    View<Real> dx;
  };
  const Call call{shape, tables, x, dy, dx};
  parallel_for((x.rows + kInputTaskRows - 1) / kInputTaskRows, [&call](std::int64_t task) {
    const std::int64_t end = std::min(call.x.rows, (task + 1) * kInputTaskRows);
    for (std::int64_t r = task * kInputTaskRows; r < end; ++r) {
      input_gradient<Real>(call.shape, call.tables, call.x.row(r), call.dy.row(r), call.dx.row(r));
    }
  });
}

template <class Real>
const HashGridKernels<Real> kTable{forward<Real>, backward_tables<Real>, backward_input<Real>};

}  // namespace

void hash_grid_cpu_kernels(KernelTables& tables) {
  tables.add(Device::cpu, "encoder 'hash_grid'", &kTable<float>);
  tables.add(Device::cpu, "encoder 'hash_grid'", &kTable<double>);
}

}  // namespace semfield::SEMFIELD_ISA
