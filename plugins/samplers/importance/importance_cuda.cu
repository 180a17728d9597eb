// CUDA kernels of the importance sampler: one warp per ray.
#include <algorithm>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "plugin/kernels.h"
#include "samplers/importance/importance_kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 128;
constexpr int kRaysPerBlock = kThreads / kWarp;
constexpr std::int64_t kSharedDoubles = 48 * 1024 / sizeof(double) / kRaysPerBlock;  // a ray

// What a launch needs of the previous pass. Its capacity is that of its rays together, so it gives the most samples
// that one ray may have.
struct Previous {
  View<const float> t, weight;
  View<const std::int32_t> first;
  std::int64_t most = 0;

  __device__ std::int32_t count(std::int64_t ray) const { return *first.row(ray + 1) - *first.row(ray); }
};

// Memory of one ray, in doubles: masses and CDF of the cells, which the merged samples replace, then the new samples.
struct RayMemory {
  std::int64_t cells = 0, fresh = 0, merged = 0;

  __host__ __device__ std::int64_t front() const { return 2 * cells > merged ? 2 * cells : merged; }
  __host__ __device__ std::int64_t doubles() const { return front() + fresh; }
};

struct SamplesOfRay {
  View<const double> near_far;
  Previous previous;
  std::int32_t samples;
  bool keep_previous;

  __device__ std::int32_t operator()(std::int64_t ray, FaultKey* fault) const {
    double near_m = 0, far_m = 0;
    if (!span_of_ray(near_far, ray, fault, near_m, far_m)) return 0;
    const std::int32_t old = previous.count(ray);
    if (old < 0 || old > previous.most) {  // not a batch of samples: there is no memory for it
      note_fault(fault, Stage::samples, ray);
      return 0;
    }
    return samples + (keep_previous ? old : 0);
  }
};

// The sums run in the CPU's order, in every lane at once: the memory is read by all lanes together.

// Masses and CDF of the ray's cells: below[k] is the CDF at the begin of cell k.
__device__ void make_cdf(const RayProposal<float>& ray, std::int64_t number, double floor, int lane, FaultKey* fault,
                         double* __restrict__ mass, double* __restrict__ below) {
  const auto count = static_cast<std::int32_t>(ray.count), cells = static_cast<std::int32_t>(ray.cells());
  if (count == 0 && lane == 0) mass[0] = 0;
  for (std::int32_t k = lane; k < count; k += kWarp) {
    double weight = ray.weight(k);
    if (!(weight >= 0) || isinf(weight)) {
      note_fault(fault, Stage::proposal_weight, number);
      weight = 0;
    }
    mass[k] = weight;
  }
  __syncwarp();
  double total = 0;
#pragma unroll 8
  for (std::int32_t k = 0; k < count; ++k) total += mass[k];
  total += floor;
  __syncwarp();
  for (std::int32_t k = lane; k < cells; k += kWarp) mass[k] = ray.cell(k, mass[k], floor, total).mass;
  __syncwarp();
  double sum = 0;
  for (std::int32_t chunk = 0; chunk < cells; chunk += kWarp) {
    const std::int32_t length = min(kWarp, cells - chunk);
    double mine = 0;
#pragma unroll 8
    for (std::int32_t i = 0; i < length; ++i) {
      if (lane == i) mine = sum;
      sum += mass[chunk + i];
    }
    if (lane < length) below[chunk + lane] = mine;
  }
  __syncwarp();
}

// The first cell that holds u: masses are not negative, so the CDF does not fall.
__device__ std::int32_t cell_of(double u, const double* below, std::int32_t cells) {
  std::int32_t low = 0, high = cells - 1;
  while (low < high) {
    const std::int32_t middle = (low + high) / 2;
    if (u < below[middle + 1]) {
      high = middle;
    } else {
      low = middle + 1;
    }
  }
  return low;
}

__device__ void draw(const ImportanceArgs& args, const RandomAddress& random, const RayProposal<float>& ray,
                     std::int64_t number, int lane, const double* __restrict__ mass, const double* __restrict__ below,
                     double* __restrict__ points) {
  const auto first_index = static_cast<std::uint64_t>((args.first_ray + number) * args.samples);
  const auto cells = static_cast<std::int32_t>(ray.cells());
  for (std::int32_t j = lane; j < args.samples; j += kWarp) {
    const double jitter =
        args.jitter ? static_cast<double>(uniform01(random, first_index + static_cast<std::uint64_t>(j))) : 0.5;
    const double u = (static_cast<double>(j) + jitter) / static_cast<double>(args.samples);
    const std::int32_t k = cell_of(u, below, cells);
    CdfWalk cell = ray.place(k);
    cell.below = below[k];
    cell.mass = mass[k];
    points[j] = cell.point(u);
  }
  __syncwarp();
}

// Each sample's place among both kinds is its own number plus how many of the other kind come before it; at equal
// distance the previous sample comes first.
__device__ void merge(const RayProposal<float>& ray, std::int32_t fresh, int lane, const double* __restrict__ points,
                      double* __restrict__ merged) {
  const auto count = static_cast<std::int32_t>(ray.count);
  for (std::int32_t k = lane; k < count; k += kWarp) {
    const double old = ray.inside(k);
    std::int32_t low = 0, high = fresh;
    while (low < high) {
      const std::int32_t middle = (low + high) / 2;
      if (points[middle] < old) {
        low = middle + 1;
      } else {
        high = middle;
      }
    }
    merged[k + low] = old;
  }
  for (std::int32_t j = lane; j < fresh; j += kWarp) {
    const double point = points[j];
    std::int32_t low = 0, high = count;
    while (low < high) {
      const std::int32_t middle = (low + high) / 2;
      if (ray.inside(middle) <= point) {
        low = middle + 1;
      } else {
        high = middle;
      }
    }
    merged[j + low] = point;
  }
  __syncwarp();
}

// One warp per ray. For 64 previous and 128 new samples it reads 0.5 KB (again from the first-level cache) and writes
// 2.3 KB, coalesced. kShared: a ray's memory lies in shared memory, else in `scratch`.
template <bool kShared>
__global__ void __launch_bounds__(kThreads)
    sample_kernel(ImportanceArgs args, View<const double> near_far, Previous previous, RayMemory sizes, double* scratch,
                  Samples<float> out, const StepCell* step, FaultKey* fault) {
  extern __shared__ double shared[];
  const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  const std::int64_t number = static_cast<std::int64_t>(blockIdx.x) * kRaysPerBlock + warp;
  if (number < near_far.rows && *out.first.row(number) < *out.first.row(number + 1)) {
    double* front = kShared ? shared + warp * sizes.doubles() : scratch + number * sizes.doubles();
    double* points = front + sizes.front();
    const RayProposal<float> ray{
        previous.t,          previous.weight,    *previous.first.row(number), previous.count(number),
        near_far(number, 0), near_far(number, 1)};
    make_cdf(ray, number, args.floor, lane, fault, front, front + sizes.cells);
    draw(args, at_step(args.random, step), ray, number, lane, front, front + sizes.cells, points);
    const auto fresh = static_cast<std::int32_t>(args.samples);
    if (args.keep_previous) merge(ray, fresh, lane, points, front);
    const double* t = args.keep_previous ? front : points;
    const std::int64_t begin = *out.first.row(number);
    const auto count = static_cast<std::int32_t>(*out.first.row(number + 1) - begin);
    for (std::int32_t k = lane; k < count; k += kWarp) {
      *out.t.row(begin + k) = round_inside<float>(t[k], ray.near_m, ray.far_m);
      *out.delta.row(begin + k) = static_cast<float>(interval_of(args.quadrature, t, count, k, ray.near_m, ray.far_m));
      *out.ray_of_sample.row(begin + k) = static_cast<std::int32_t>(number);
    }
  }
  fill_unused_rows(out, near_far.rows);
}

// With launch().check_at_once: throws for a fault of Stage::proposal_weight.
void throw_bad_weight(const Previous& previous, std::int64_t first_ray) {
  const std::int64_t ray = first_fault_row(Stage::proposal_weight);
  if (ray < 0) return;
  std::int32_t rows[2];
  for (int i = 0; i < 2; ++i) download<std::int32_t>(previous.first.row(ray + i), {rows + i, 1});
  synchronize();
  for (std::int32_t row = rows[0]; row < rows[1]; ++row) {
    float weight = 0;
    download<float>(previous.weight.row(row), {&weight, 1});
    synchronize();
    if (!(weight >= 0) || isinf(weight)) {
      bad_proposal_weight(first_ray + ray, row - rows[0], static_cast<double>(weight));
    }
  }
}

void sample(const ImportanceArgs& args, View<const double> near_far, const Proposal<float>& proposal,
            Samples<float>& out) {
  SEMFIELD_CHECK(args.workspace != nullptr, "the importance sampler needs scratch memory");
  const std::int64_t rays = near_far.rows;
  const Samples<float>& old = *proposal.samples;
  out.count = rays * args.samples + (args.keep_previous ? old.count : 0);
  if (rays == 0) return;
  const Previous previous{old.t, proposal.weight, old.first, old.count / rays};
  queue_offsets(SamplesOfRay{near_far, previous, static_cast<std::int32_t>(args.samples), args.keep_previous}, rays,
                out.first);
  RayMemory sizes;
  sizes.cells = std::max<std::int64_t>(1, previous.most);
  sizes.fresh = args.samples;
  sizes.merged = args.keep_previous ? args.samples + previous.most : 0;
  const unsigned blocks = blocks_of(rays, kRaysPerBlock);
  Workspace::Scope scope(*args.workspace);
  if (sizes.doubles() <= kSharedDoubles) {
    const auto bytes = static_cast<std::size_t>(kRaysPerBlock * sizes.doubles()) * sizeof(double);
    sample_kernel<true><<<blocks, kThreads, bytes, launch().stream>>>(args, near_far, previous, sizes, nullptr, out,
                                                                      launch().cell, launch().fault);
  } else {
    double* scratch = args.workspace->take<double>(rays * sizes.doubles(), 1).data;
    sample_kernel<false><<<blocks, kThreads, 0, launch().stream>>>(args, near_far, previous, sizes, scratch, out,
                                                                   launch().cell, launch().fault);
  }
  check_launch("importance sample");
  throw_bad_limits(near_far, args.first_ray);
  throw_bad_weight(previous, args.first_ray);
}

const ImportanceKernels<float> kTable{sample};

}  // namespace

void importance_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "sampler 'importance'", &kTable); }

}  // namespace semfield::cuda
