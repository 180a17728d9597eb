// CUDA kernels of the occupancy-grid sampler: one warp marches along a ray, 32 steps of its lattice at a time.

#include <algorithm>
#include <cmath>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/launch.h"
#include "plugin/kernels.h"
#include "samplers/occupancy_grid/occupancy_grid_kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 128;
constexpr int kRaysPerBlock = kThreads / kWarp;
constexpr double kNever = 1e300;  // price of a jump that there is not

struct Grid {
  OccupancyGeometry geometry;
  OccupancyState<float> state;
  bool is_plain_threshold = false, keep_last = false;
};

// A step of the lattice as its lane sees it. Most are settled by the grid alone: they are samples, or they are passed
// over, with their cell or their whole block. The others are samples unless the budget pays a jump from them.
struct Step {
  OccupancyCell cell;
  double block_bound = 0, cell_bound = 0;  // kUnbounded: must be looked at
  bool passes = false, passes_block = false, may_jump = false;

  __device__ static Step of(const Grid& grid, const MarchedRay& ray, double even_density, std::int32_t i) {
    Step step;
    step.cell = ray.cell_at(grid.geometry, i);
    const std::int64_t index = step.cell.index(grid.geometry.n);
    step.block_bound = static_cast<double>(grid.state.block_bound[step.cell.block(grid.geometry.blocks_per_side())]);
    const double density = grid.is_plain_threshold ? 0.0 : static_cast<double>(grid.state.density[index]);
    const bool empty = is_empty_cell<float>(reinterpret_cast<const unsigned char*>(grid.state.empty_bits), index);
    step.cell_bound = empty ? density : kUnbounded;
    const bool bounded_block = step.block_bound < kUnbounded, bounded_cell = step.cell_bound < kUnbounded;
    step.passes_block = bounded_block && step.block_bound <= even_density;
    step.passes = step.passes_block || (!bounded_block && bounded_cell && step.cell_bound <= even_density);
    step.may_jump = !step.passes && (bounded_block || bounded_cell);
    return step;
  }
};

// The jumps from a step, over its block or its cell, and what they cost.
struct Jumps {
  std::int32_t behind_block = 0, behind_cell = 0;
  double block_price = kNever, cell_price = kNever;

  __device__ static Jumps of(const Grid& grid, const MarchedRay& ray, double even_density, const Step& step,
                             std::int32_t i) {
    Jumps jumps;
    jumps.behind_block = behind(grid, ray, step.cell, kBlockCells, i);
    jumps.behind_cell = behind(grid, ray, step.cell, 1, i);
    if (step.block_bound < kUnbounded)
      jumps.block_price = step.block_bound * ray.lattice.length_m(i, jumps.behind_block);
    if (step.cell_bound < kUnbounded) {
      jumps.cell_price =
          step.cell_bound <= even_density ? 0.0 : step.cell_bound * ray.lattice.length_m(i, jumps.behind_cell);
    }
    return jumps;
  }
  // As GridReader::stretch_from: the first step that is not surely in the cube, before keep_last.
  __device__ static std::int32_t behind(const Grid& grid, const MarchedRay& ray, const OccupancyCell& cell,
                                        std::int32_t size, std::int32_t i) {
    return static_cast<std::int32_t>(ray.behind(grid.geometry, cell, size, i));
  }
};

// Lanes [0, 32) of a window of the lattice that are samples, and the step at which the march goes on.
struct Window {
  unsigned kept = 0;
  std::int32_t next = 0;
};

// The march through one window. The CPU goes from stretch to stretch; all steps of a stretch that the grid settles are
// settled alike, so here each lane decides for its own, and only paid jumps are taken one after the other: the
// first step that can pay one, at what is left of the budget, ends what was settled before it.
__device__ Window look(const Grid& grid, const MarchedRay& ray, SkipBudget& budget, std::int32_t base, int lane) {
  const auto count = static_cast<std::int32_t>(ray.lattice.count);
  const std::int32_t i = base + lane, last = grid.keep_last ? count - 1 : count;
  const Step step = Step::of(grid, ray, budget.even_density, i);
  const bool kept = i < count && (i >= last || !step.passes);
  const bool may_jump = i < last && step.may_jump;
  Window window;
  window.next = base + kWarp;
  int from = 0;
  if (__any_sync(kFullMask, may_jump)) {
    const Jumps jumps = Jumps::of(grid, ray, budget.even_density, step, i);
    while (from < kWarp) {
      const bool over_block = jumps.block_price <= budget.left;
      const double price = over_block ? jumps.block_price : jumps.cell_price;
      const unsigned jumping = __ballot_sync(kFullMask, may_jump && lane >= from && price <= budget.left);
      const int event = jumping == 0 ? kWarp : __ffs(static_cast<int>(jumping)) - 1;
      window.kept |= __ballot_sync(kFullMask, kept && lane >= from && lane < event);
      if (event == kWarp) break;
      const std::int32_t to = __shfl_sync(kFullMask, over_block ? jumps.behind_block : jumps.behind_cell, event);
      budget.left -= __shfl_sync(kFullMask, price, event);
      window.next = max(window.next, min(to, last));
      from = min(to, last) - base;
    }
  } else {
    window.kept = __ballot_sync(kFullMask, kept);
  }
  const bool reached_end = from < kWarp;
  if (reached_end && __shfl_sync(kFullMask, static_cast<int>(i < last && step.passes_block), kWarp - 1) != 0) {
    const std::int32_t to = Jumps::behind(grid, ray, step.cell, kBlockCells, i);
    window.next = min(__shfl_sync(kFullMask, to, kWarp - 1), last);
  }
  return window;
}

// Places of a ray's samples, and their lengths where these differ (else null).
struct Slots {
  float* t = nullptr;
  float* delta = nullptr;
};

// Samples of the lattice into `slots`; -1 when they are more than `most`.
__device__ std::int32_t march(const Grid& grid, const MarchedRay& ray, double skip_budget, std::int64_t most, int lane,
                              const Slots& slots) {
  SkipBudget budget(skip_budget, ray.length_m());
  std::int32_t written = 0;
  for (std::int32_t base = 0; base < ray.lattice.count;) {
    const Window window = look(grid, ray, budget, base, lane);
    if (written + __popc(window.kept) > most) return -1;
    if ((window.kept >> lane & 1u) != 0) {
      const std::int32_t slot = written + __popc(window.kept & ((1u << lane) - 1));
      const std::int64_t i = base + lane;
      slots.t[slot] = round_inside<float>(ray.lattice.at(i), ray.lattice.near_m, ray.far_m);
      if (slots.delta != nullptr) slots.delta[slot] = static_cast<float>(ray.lattice.length_m(i, i + 1));
    }
    written += __popc(window.kept);
    base = window.next;
  }
  return written;
}

// What a march leaves: max_samples slots a ray, of which `count` are in use, and the length of a step.
struct Marched {
  Slots slots;
  std::int32_t* count = nullptr;
  float* step_m = nullptr;
};

// One warp per ray. A window reads a few sectors of the three arrays, which the second-level cache holds, and each
// sample is written to its slot, coalesced. A ray with too many samples begins anew with half the steps, as on the CPU.
__global__ void __launch_bounds__(kThreads) march_kernel(OccupancySampleArgs args, Grid grid, Box box, Rays<float> rays,
                                                         Marched out, const StepCell* step, FaultKey* fault) {
  const int lane = static_cast<int>(threadIdx.x) % kWarp;
  const std::int64_t number =
      static_cast<std::int64_t>(blockIdx.x) * kRaysPerBlock + static_cast<int>(threadIdx.x) / kWarp;
  if (number >= rays.near_far.rows) return;
  std::int32_t count = 0;
  double near_m = 0, far_m = 0;
  MarchedRay ray;
  if (span_of_ray(rays.near_far, number, fault, near_m, far_m) &&
      ray.begin(grid.geometry, box, rays.origin.row(number), rays.direction.row(number), near_m, far_m)) {
    if (args.jitter) {
      ray.lattice.u = static_cast<double>(
          uniform01(at_step(args.random, step), static_cast<std::uint64_t>(args.first_ray + number)));
    }
    const std::int64_t first = number * args.max_samples;
    const Slots slots{out.slots.t + first, out.slots.delta == nullptr ? nullptr : out.slots.delta + first};
    for (ray.lay_out(); (count = march(grid, ray, args.skip_budget, args.max_samples, lane, slots)) < 0;
         ray.lay_out()) {
      ray.lattice.count = (ray.lattice.count + 1) / 2;
    }
  }
  if (lane != 0) return;
  out.count[number] = count;
  out.step_m[number] = static_cast<float>(ray.lattice.step_m);
}

struct MarchedSamples {
  const std::int32_t* count;
  __device__ std::int32_t operator()(std::int64_t ray, FaultKey*) const { return count[ray]; }
};

// One warp per ray: 4 bytes per sample read and 12 written, coalesced.
__global__ void __launch_bounds__(kThreads)
    close_up_kernel(std::int64_t max_samples, std::int64_t rays, Marched marched, Samples<float> out) {
  const int lane = static_cast<int>(threadIdx.x) % kWarp;
  const std::int64_t number =
      static_cast<std::int64_t>(blockIdx.x) * kRaysPerBlock + static_cast<int>(threadIdx.x) / kWarp;
  if (number < rays) {
    const std::int64_t begin = *out.first.row(number);
    const std::int32_t count = static_cast<std::int32_t>(*out.first.row(number + 1) - begin);
    const float step_m = marched.step_m[number];
    const std::int64_t slot = number * max_samples;
    for (std::int32_t k = lane; k < count; k += kWarp) {
      *out.t.row(begin + k) = marched.slots.t[slot + k];
      *out.delta.row(begin + k) = marched.slots.delta == nullptr ? step_m : marched.slots.delta[slot + k];
      *out.ray_of_sample.row(begin + k) = static_cast<std::int32_t>(number);
    }
  }
  fill_unused_rows(out, rays);
}

void sample(const OccupancySampleArgs& args, const OccupancyState<float>& state, const Rays<float>& rays,
            Samples<float>& out) {
  SEMFIELD_CHECK(args.workspace != nullptr, "the occupancy grid needs scratch memory");
  const std::int64_t count = rays.near_far.rows, most = count * args.max_samples;
  out.count = std::min(most, out.t.rows);
  if (count == 0) return;
  Workspace::Scope scope(*args.workspace);
  const Slots slots{args.workspace->take<float>(most, 1).data,
                    args.geometry.equal_m > 0 ? args.workspace->take<float>(most, 1).data : nullptr};
  const Marched marched{slots, args.workspace->take<std::int32_t>(count, 1).data,
                        args.workspace->take<float>(count, 1).data};
  const Grid grid{args.geometry, state, std::isinf(args.skip_budget), args.keep_last};
  const unsigned blocks = blocks_of(count, kRaysPerBlock);
  march_kernel<<<blocks, kThreads, 0, launch().stream>>>(args, grid, args.geometry.outer(), rays, marched,
                                                         launch().cell, launch().fault);
  check_launch("occupancy march");
  queue_offsets(MarchedSamples{marched.count}, count, out.first, out.count);
  close_up_kernel<<<blocks, kThreads, 0, launch().stream>>>(args.max_samples, count, marched, out);
  check_launch("occupancy samples");
  throw_bad_limits(rays.near_far, args.first_ray);
}

// CUDA kernels of the occupancy grid's update and of what sampling reads.

constexpr int kUpdateThreads = 256;
constexpr int kWarps = kUpdateThreads / kWarp;
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

__device__ std::int64_t thread_number() { return static_cast<std::int64_t>(blockIdx.x) * kUpdateThreads + threadIdx.x; }
__device__ bool has_fault(const FaultKey* fault) { return fault != nullptr && *fault != kNoFault; }

// One thread per cell, 24 bytes written. Cells that a finer cascade covers get a point too and are left out afterwards:
// a row's number says which cell it is, and they are an eighth of a cascade.
__global__ void __launch_bounds__(kUpdateThreads)
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
__global__ void __launch_bounds__(kUpdateThreads)
    check_kernel(DrawnCells drawn, View<const float> sigma, FaultKey* fault) {
  const std::int64_t row = thread_number();
  if (row >= drawn.rows || drawn.covered(row)) return;
  const float value = *sigma.row(row);
  if (!(value >= 0) || isinf(value)) note_fault(fault, Stage::occupancy_density, drawn.index(row));
}

// One thread per cell, 8 bytes read and 4 written.
__global__ void __launch_bounds__(kUpdateThreads)
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
__global__ void __launch_bounds__(kUpdateThreads)
    add_up_kernel(const float* density, std::int64_t cells, std::int64_t per_block, Totals* partials) {
  const std::int64_t begin = blockIdx.x * per_block;
  const std::int64_t end = begin + per_block < cells ? begin + per_block : cells;
  Totals sum{};
#pragma unroll 4
  for (std::int64_t i = begin + 4 * static_cast<std::int64_t>(threadIdx.x); i < end; i += 4 * kUpdateThreads) {
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
__global__ void __launch_bounds__(kUpdateThreads)
    decide_kernel(const Totals* partials, int count, double optical_threshold, const FaultKey* fault,
                  Marking* marking) {
  Totals sum{};
  for (int i = static_cast<int>(threadIdx.x); i < count; i += kUpdateThreads) {
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
__global__ void __launch_bounds__(kUpdateThreads)
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

// As in OccupancyGridKernels, queued on launch().stream: nothing waits. A bad density is a fault of
// Stage::occupancy_density with its cell's index; from then on nothing is written.
void update(const OccupancyUpdateArgs& args, const OccupancyState<float>& state, const DensityQuery<float>& query) {
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
    const unsigned blocks = blocks_of(drawn.rows, kUpdateThreads);
    const View<double> x = positions.row_range(0, drawn.rows);
    const View<float> y = sigma.row_range(0, drawn.rows);
    draw_kernel<<<blocks, kUpdateThreads, 0, launch().stream>>>(drawn, args.random, x);
    check_launch("occupancy points");
    query(x, y);
    check_kernel<<<blocks, kUpdateThreads, 0, launch().stream>>>(drawn, y, launch().fault);
    check_launch("occupancy check");
    throw_bad_density(drawn, x, y);
    absorb_kernel<<<blocks, kUpdateThreads, 0, launch().stream>>>(drawn, static_cast<float>(args.decay), y,
                                                                  state.density, launch().fault);
    check_launch("occupancy update");
  }
}

void publish(const OccupancyUpdateArgs& args, const OccupancyState<float>& state) {
  SEMFIELD_CHECK(args.workspace != nullptr, "the occupancy grid needs scratch memory");
  const OccupancyGeometry& geometry = args.geometry;
  const std::int64_t cells = geometry.cells(), pairs = geometry.blocks() / 2;
  constexpr std::int64_t kRound = 4 * kUpdateThreads;
  const std::int64_t rounds = (cells / kRound + kMostPartials - 1) / kMostPartials;
  const std::int64_t per_block = rounds * kRound;
  const auto partial_count = static_cast<int>((cells + per_block - 1) / per_block);
  Workspace::Scope scope(*args.workspace);
  Totals* partials = args.workspace->take<Totals>(partial_count, 1).data;
  Marking* marking = args.workspace->take<Marking>(1, 1).data;
  const cudaStream_t stream = launch().stream;
  add_up_kernel<<<static_cast<unsigned>(partial_count), kUpdateThreads, 0, stream>>>(state.density, cells, per_block,
                                                                                     partials);
  check_launch("occupancy sum");
  decide_kernel<<<1, kUpdateThreads, 0, stream>>>(partials, partial_count, args.threshold / geometry.step_m,
                                                  launch().fault, marking);
  check_launch("occupancy threshold");
  mark_kernel<<<blocks_of(pairs, kWarps), kUpdateThreads, 0, stream>>>(geometry, state, pairs, marking);
  check_launch("occupancy marks");
  summary_kernel<<<1, 1, 0, stream>>>(marking, state.summary);
  check_launch("occupancy summary");
}

const OccupancyGridKernels<float> kTable{sample, update, publish};

}  // namespace

void occupancy_grid_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "sampler 'occupancy_grid'", &kTable);
}

}  // namespace semfield::cuda
