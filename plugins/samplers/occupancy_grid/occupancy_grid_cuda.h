// What the occupancy grid's CUDA files share.
#pragma once

#include "samplers/occupancy_grid/occupancy_grid_kernels.h"

namespace semfield::cuda {

/// As in OccupancyGridKernels, queued on launch().stream: nothing waits. A bad density is a fault of
/// Stage::occupancy_density with its cell's index; from then on nothing is written.
void occupancy_update(const OccupancyUpdateArgs& args, const OccupancyState<float>& state,
                      const DensityQuery<float>& query);
void occupancy_publish(const OccupancyUpdateArgs& args, const OccupancyState<float>& state);

}  // namespace semfield::cuda
