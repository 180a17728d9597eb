// Arguments and kernel table of the hash grid.
#pragma once

#include "core/view.h"
#include "encoders/hash_grid/hash_grid_math.h"

namespace semfield {

class KernelTables;
class Workspace;

inline constexpr std::int32_t kHashGridMaxLevels = 32;
inline constexpr std::int32_t kHashGridMaxFeatures = 8;

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
  /// Parallel over levels and rows where the caller is not. Scratch: see scratch_bytes.
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
  /// Of forward and backward_tables. Null: not planned ahead on this device.
  std::size_t (*scratch_bytes)(const HashGridShape& shape, std::int64_t rows) = nullptr;
};

void hash_grid_kernels(KernelTables& tables);

}  // namespace semfield
