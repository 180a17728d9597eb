// CUDA kernels of the occupancy grid's update and of what sampling reads.
#include <algorithm>
#include <cmath>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/memory.h"
#include "samplers/occupancy_grid/occupancy_grid_cuda.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / kWarp;
constexpr std::int64_t kChunkCells = std::int64_t{1} << 18;  // of one density query
constexpr std::int64_t kMostPartials = 1024;

// Cells [begin, begin + rows) of those of an update.
struct DrawnCells {
  OccupancyGeometry geometry;
  std::int64_t parts = 1, part = 0, begin = 0, rows = 0;

  __host__ __device__ std::int64_t index(std::int64_t row) const { return part + (begin + row) * parts; }
  __device__ bool covered(std::int64_t row) const {
    return covered_by_finer(cell_of_index(index(row), geometry.n), geometry.n);
  }
};

__device__ std::int64_t thread_number() { return static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x; }
__device__ bool has_fault(const FaultKey* fault) { return fault != nullptr && *fault != kNoFault; }

// One thread per cell, 24 bytes written. Cells that a finer cascade covers get a point too and are left out afterwards:
// a row's number says which cell it is, and they are an eighth of a cascade.
__global__ void __launch_bounds__(kThreads)
    draw_kernel(DrawnCells drawn, RandomAddress random, View<double> positions) {
  const std::int64_t row = thread_number();
  if (row >= drawn.rows) return;
  const std::int64_t index = drawn.index(row);
  const PhiloxBlock block = random_block(random, static_cast<std::uint64_t>(index));
  const Vec3d share{block.v[0] * 0x1p-32, block.v[1] * 0x1p-32, block.v[2] * 0x1p-32};
  const Vec3d p = point_in_cell(drawn.geometry, cell_of_index(index, drawn.geometry.n), share);
  positions(row, 0) = p.x;
  positions(row, 1) = p.y;
  positions(row, 2) = p.z;
}

// One thread per cell, 4 bytes read.
__global__ void __launch_bounds__(kThreads) check_kernel(DrawnCells drawn, View<const float> sigma, FaultKey* fault) {
  const std::int64_t row = thread_number();
  if (row >= drawn.rows || drawn.covered(row)) return;
  const float value = *sigma.row(row);
  if (!(value >= 0) || isinf(value)) note_fault(fault, Stage::occupancy_density, drawn.index(row));
}

// One thread per cell, 8 bytes read and 4 written.
__global__ void __launch_bounds__(kThreads)
    absorb_kernel(DrawnCells drawn, float decay, View<const float> sigma, float* density, const FaultKey* fault) {
  const std::int64_t row = thread_number();
  if (row >= drawn.rows || has_fault(fault) || drawn.covered(row)) return;
  float& value = density[drawn.index(row)];
  value = std::max(value * decay, *sigma.row(row));  // an unseen cell holds -1
}

// With launch().check_at_once: throws for a fault of Stage::occupancy_density.
void throw_bad_density(const DrawnCells& drawn, View<const double> positions, View<const float> sigma) {
  const std::int64_t index = first_fault_row(Stage::occupancy_density);
  if (index < 0) return;
  const std::int64_t row = (index - drawn.part) / drawn.parts - drawn.begin;
  double position[3];
  float value = 0;
  download<double>(positions.row(row), position);
  download<float>(sigma.row(row), {&value, 1});
  synchronize();
  bad_density(position, static_cast<double>(value));
}

struct Totals {
  double density;
  std::int64_t seen;
};

// Sums over a block in a fixed tree; thread 0 has them.
__device__ Totals block_sum(Totals mine) {
  __shared__ Totals of_warp[kWarps];
  const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  mine.density = warp_sum(mine.density);
  mine.seen = warp_sum(mine.seen);
  if (lane == 0) of_warp[warp] = mine;
  __syncthreads();
  Totals sum{};
  for (int w = 0; w < kWarps; ++w) {
    sum.density += of_warp[w].density;
    sum.seen += of_warp[w].seen;
  }
  return sum;
}

// Block b adds up cells [b per_block, (b + 1) per_block), 4 per thread and round: 4 bytes per cell read, coalesced. A
// fixed order of sums.
__global__ void __launch_bounds__(kThreads)
    add_up_kernel(const float* density, std::int64_t cells, std::int64_t per_block, Totals* partials) {
  const std::int64_t begin = blockIdx.x * per_block;
  const std::int64_t end = begin + per_block < cells ? begin + per_block : cells;
  Totals sum{};
#pragma unroll 4
  for (std::int64_t i = begin + 4 * static_cast<std::int64_t>(threadIdx.x); i < end; i += 4 * kThreads) {
    const float4 four = *reinterpret_cast<const float4*>(density + i);
    for (const float value : {four.x, four.y, four.z, four.w}) {
      if (!(value >= 0)) continue;
      sum.density += static_cast<double>(value);
      sum.seen += 1;
    }
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) partials[blockIdx.x] = sum;
}

// What marking needs to know, and what it counts.
struct Marking {
  double mean = 0;
  float occupied_above = 0;
  bool goes_on = false;
  unsigned long long occupied = 0, counted = 0;
};

// One block. A grid without any density tells nothing yet: leaving out everything would end all learning.
__global__ void __launch_bounds__(kThreads) decide_kernel(const Totals* partials, int count, double optical_threshold,
                                                          const FaultKey* fault, Marking* marking) {
  Totals sum{};
  for (int i = static_cast<int>(threadIdx.x); i < count; i += kThreads) {
    sum.density += partials[i].density;
    sum.seen += partials[i].seen;
  }
  sum = block_sum(sum);
  if (threadIdx.x != 0) return;
  Marking result;
  result.goes_on = sum.density > 0 && !has_fault(fault);
  if (result.goes_on) {
    result.mean = sum.density / static_cast<double>(sum.seen);
    // Half the mean, so that a grid of equal densities is occupied, not empty.
    result.occupied_above = static_cast<float>(std::min(optical_threshold, 0.5 * result.mean));
  }
  *marking = result;
}

// Eight cells of a row that lie in one block: their empty bits, and the largest bound joined to `bound`.
__device__ unsigned mark_eight(const float4& low, const float4& high, float occupied_above, float& bound) {
  unsigned bits = 0, bit = 1;
  for (const float density : {low.x, low.y, low.z, low.w, high.x, high.y, high.z, high.w}) {
    const bool occupied = density < 0 || density > occupied_above;
    if (!occupied) bits |= bit;
    bound = std::max(bound, occupied ? static_cast<float>(kUnbounded) : density);
    bit *= 2;
  }
  return bits;
}

// One warp marks two blocks that are neighbours in x, so that 16 cells of a row give an element of empty_bits. A lane
// takes 2 of their 64 rows: 64 bytes read and 4 written per row. Counts are integers: the order of atomics does not
// matter.
__global__ void __launch_bounds__(kThreads)
    mark_kernel(OccupancyGeometry geometry, OccupancyState<float> state, std::int64_t pairs, Marking* marking) {
  if (!marking->goes_on) return;
  const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  const std::int64_t pair = static_cast<std::int64_t>(blockIdx.x) * kWarps + warp;
  std::int32_t occupied = 0, counted = 0;
  if (pair < pairs) {
    const std::int32_t side = geometry.blocks_per_side();
    OccupancyCell corner;
    corner.at[0] = static_cast<std::int32_t>(pair % (side / 2)) * kBitsPerElement;
    corner.at[1] = static_cast<std::int32_t>(pair / (side / 2) % side) * kBlockCells;
    corner.at[2] = static_cast<std::int32_t>(pair / (side / 2) / side % side) * kBlockCells;
    corner.cascade = static_cast<std::int32_t>(pair / (side / 2) / side / side);
    const float occupied_above = geometry.occupied_above(marking->occupied_above, corner.cascade);
    OccupancyCell right = corner;
    right.at[0] += kBlockCells;
    // A finer grid's border is a multiple of 8 cells.
    const bool left_counts = !covered_by_finer(corner, geometry.n), right_counts = !covered_by_finer(right, geometry.n);
    float left_bound = 0, right_bound = 0;
    for (int half = 0; half < 2; ++half) {
      OccupancyCell row = corner;
      row.at[1] += lane % kBlockCells;
      row.at[2] += lane / kBlockCells + half * (kBlockCells / 2);
      const std::int64_t index = row.index(geometry.n);
      const auto* density = reinterpret_cast<const float4*>(state.density + index);
      const float4 four[4] = {density[0], density[1], density[2], density[3]};
      unsigned bits = 0;
      if (left_counts) bits = mark_eight(four[0], four[1], occupied_above, left_bound);
      if (right_counts) bits |= mark_eight(four[2], four[3], occupied_above, right_bound) << kBlockCells;
      // The bits take the place of the low half of 1.0.
      state.empty_bits[index / kBitsPerElement] = __uint_as_float(__float_as_uint(1.0F) | bits);
      const std::int32_t cells = (left_counts ? kBlockCells : 0) + (right_counts ? kBlockCells : 0);
      counted += cells;
      occupied += cells - __popc(bits);
    }
    for (int offset = kWarp / 2; offset > 0; offset /= 2) {
      left_bound = std::max(left_bound, __shfl_xor_sync(kFullMask, left_bound, offset));
      right_bound = std::max(right_bound, __shfl_xor_sync(kFullMask, right_bound, offset));
    }
    if (lane == 0) {
      state.block_bound[corner.block(side)] = left_bound;
      state.block_bound[right.block(side)] = right_bound;
    }
  }
  occupied = warp_sum(occupied);
  counted = warp_sum(counted);
  if (lane != 0 || counted == 0) return;
  atomicAdd(&marking->occupied, static_cast<unsigned long long>(occupied));
  atomicAdd(&marking->counted, static_cast<unsigned long long>(counted));
}

// One thread.
__global__ void summary_kernel(const Marking* marking, float* summary) {
  if (!marking->goes_on) return;
  summary[0] = static_cast<float>(marking->mean);
  summary[1] = marking->occupied_above;
  summary[2] = static_cast<float>(static_cast<double>(marking->occupied) / static_cast<double>(marking->counted));
}

}  // namespace

void occupancy_update(const OccupancyUpdateArgs& args, const OccupancyState<float>& state,
                      const DensityQuery<float>& query) {
  SEMFIELD_CHECK(args.workspace != nullptr, "the occupancy grid needs scratch memory");
  const std::int64_t cells = args.geometry.cells();
  const std::int64_t chosen = args.part < cells ? (cells - args.part + args.parts - 1) / args.parts : 0;
  const std::int64_t held = std::min(chosen, kChunkCells);
  Workspace::Scope scope(*args.workspace);
  const View<double> positions = args.workspace->take<double>(held, 3);
  const View<float> sigma = args.workspace->take<float>(held, 1);
  DrawnCells drawn{args.geometry, args.parts, args.part};
  for (; drawn.begin < chosen; drawn.begin += drawn.rows) {
    drawn.rows = std::min(kChunkCells, chosen - drawn.begin);
    const unsigned blocks = blocks_of(drawn.rows, kThreads);
    const View<double> x = positions.row_range(0, drawn.rows);
    const View<float> y = sigma.row_range(0, drawn.rows);
    draw_kernel<<<blocks, kThreads, 0, launch().stream>>>(drawn, args.random, x);
    check_launch("occupancy points");
    query(x, y);
    check_kernel<<<blocks, kThreads, 0, launch().stream>>>(drawn, y, launch().fault);
    check_launch("occupancy check");
    throw_bad_density(drawn, x, y);
    absorb_kernel<<<blocks, kThreads, 0, launch().stream>>>(drawn, static_cast<float>(args.decay), y, state.density,
                                                            launch().fault);
    check_launch("occupancy update");
  }
}

void occupancy_publish(const OccupancyUpdateArgs& args, const OccupancyState<float>& state) {
  SEMFIELD_CHECK(args.workspace != nullptr, "the occupancy grid needs scratch memory");
  const OccupancyGeometry& geometry = args.geometry;
  const std::int64_t cells = geometry.cells(), pairs = geometry.blocks() / 2;
  constexpr std::int64_t kRound = 4 * kThreads;
  const std::int64_t rounds = (cells / kRound + kMostPartials - 1) / kMostPartials;
  const std::int64_t per_block = rounds * kRound;
  const auto partial_count = static_cast<int>((cells + per_block - 1) / per_block);
  Workspace::Scope scope(*args.workspace);
  Totals* partials = args.workspace->take<Totals>(partial_count, 1).data;
  Marking* marking = args.workspace->take<Marking>(1, 1).data;
  const cudaStream_t stream = launch().stream;
  add_up_kernel<<<static_cast<unsigned>(partial_count), kThreads, 0, stream>>>(state.density, cells, per_block,
                                                                               partials);
  check_launch("occupancy sum");
  decide_kernel<<<1, kThreads, 0, stream>>>(partials, partial_count, args.threshold / geometry.step_m, launch().fault,
                                            marking);
  check_launch("occupancy threshold");
  mark_kernel<<<blocks_of(pairs, kWarps), kThreads, 0, stream>>>(geometry, state, pairs, marking);
  check_launch("occupancy marks");
  summary_kernel<<<1, 1, 0, stream>>>(marking, state.summary);
  check_launch("occupancy summary");
}

}  // namespace semfield::cuda
