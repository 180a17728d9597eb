// CUDA kernels of the occupancy-grid sampler: one warp marches along a ray, 32 steps of its lattice at a time.
#include <algorithm>
#include <cmath>

#include "core/check.h"
#include "cuda/kernels/sampling.cuh"
#include "plugin/kernels.h"
#include "samplers/occupancy_grid/occupancy_grid_cuda.h"

namespace semfield::cuda {

void occupancy_grid_cuda_kernels(KernelTables& tables);

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

const OccupancyGridKernels<float> kTable{sample, occupancy_update, occupancy_publish};

}  // namespace

void occupancy_grid_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "sampler 'occupancy_grid'", &kTable);
}

}  // namespace semfield::cuda
