// Kernel table of the occupancy-grid sampler.
#pragma once

#include "core/rng.h"
#include "core/workspace.h"
#include "plugin/sampler.h"
#include "samplers/occupancy_grid/occupancy_grid_math.h"

namespace semfield {

class KernelTables;

/// The state tensors; strides are 1.
template <class Real>
struct OccupancyState {
  Real* density = nullptr;      ///< [cells]
  Real* empty_bits = nullptr;   ///< [cells / 16]
  Real* block_bound = nullptr;  ///< [blocks] largest density of the block, kUnbounded with an occupied cell in it
  Real* summary = nullptr;      ///< [3] mean density, density above which a cell is occupied, share of occupied cells
};

struct OccupancySampleArgs {
  OccupancyGeometry geometry;
  std::int64_t max_samples = 0;
  bool keep_last = false;  ///< the last step of a ray is never skipped
  double skip_budget = 0;  ///< infinite: plain threshold
  bool jitter = false;
  RandomAddress random;
  std::int64_t first_ray = 0;
  Workspace* workspace = nullptr;  ///< read on devices other than the CPU
};

struct OccupancyUpdateArgs {
  OccupancyGeometry geometry;
  std::int64_t parts = 1, part = 0;  ///< cells with index mod parts == part are drawn
  double decay = 1;                  ///< of a drawn cell's old value
  double threshold = 0.01;           ///< optical depth of a step
  RandomAddress random;
  Workspace* workspace = nullptr;
};

template <class Real>
struct OccupancyGridKernels {
  void (*sample)(const OccupancySampleArgs& args, const OccupancyState<Real>& state, const Rays<Real>& rays,
                 Samples<Real>& out) = nullptr;
  /// Draws a point in each chosen cell and keeps the larger of its density and the decayed old value.
  void (*update)(const OccupancyUpdateArgs& args, const OccupancyState<Real>& state,
                 const DensityQuery<Real>& query) = nullptr;
  /// Makes bits, block bounds and summary from the densities.
  void (*publish)(const OccupancyUpdateArgs& args, const OccupancyState<Real>& state) = nullptr;
};

void occupancy_grid_kernels(KernelTables& tables);

/// Throws Error(failure) that names the place [3] and the density.
[[noreturn]] void bad_density(const double* position, double sigma);

}  // namespace semfield
