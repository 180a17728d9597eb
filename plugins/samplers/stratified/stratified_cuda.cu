// CUDA kernels of the stratified sampler.
#include "cuda/kernels/device_code.cuh"
#include "plugin/kernels.h"
#include "samplers/stratified/stratified_kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 128;
constexpr int kRaysPerBlock = kThreads / kWarp;

struct BinsOfRay {
  View<const double> near_far;
  std::int32_t samples;

  __device__ std::int32_t operator()(std::int64_t ray, FaultKey* fault) const {
    double near_m = 0, far_m = 0;
    return span_of_ray(near_far, ray, fault, near_m, far_m) ? samples : 0;
  }
};

// One warp per ray, one lane a bin, the last 32 bins first: an interval ends at the sample behind it, which the next
// lane or the round before drew. 24 bytes per ray are read and 12 per sample written, coalesced.
__global__ void __launch_bounds__(kThreads)
    sample_kernel(StratifiedArgs args, View<const double> near_far, Samples<float> out, const StepCell* cell) {
  const int lane = static_cast<int>(threadIdx.x) % kWarp;
  const std::int64_t ray =
      static_cast<std::int64_t>(blockIdx.x) * kRaysPerBlock + static_cast<int>(threadIdx.x) / kWarp;
  if (ray < near_far.rows && *out.first.row(ray) < *out.first.row(ray + 1)) {
    const std::int64_t begin = *out.first.row(ray);
    const double near_m = near_far(ray, 0), far_m = near_far(ray, 1);
    const auto first_index = static_cast<std::uint64_t>((args.first_ray + ray) * args.samples);
    const RandomAddress random = at_step(args.random, cell);
    const auto n = static_cast<std::int32_t>(args.samples);
    double after = far_m;
    for (std::int32_t chunk = (n - 1) / kWarp * kWarp; chunk >= 0; chunk -= kWarp) {
      const std::int32_t k = chunk + lane;
      const double u =
          args.jitter ? static_cast<double>(uniform01(random, first_index + static_cast<std::uint64_t>(k))) : 0.5;
      const double t = point_of_bin(args.spacing, near_m, far_m, k, u, args.samples);
      const double of_next_lane = __shfl_down_sync(kFullMask, t, 1);
      const double end = k + 1 == n ? far_m : lane == kWarp - 1 ? after : of_next_lane;
      after = __shfl_sync(kFullMask, t, 0);
      if (k >= n) continue;
      *out.t.row(begin + k) = round_inside<float>(t, near_m, far_m);
      *out.delta.row(begin + k) = static_cast<float>(
          args.quadrature == Quadrature::paper ? end - t : length_of_bin(args.spacing, near_m, far_m, k, args.samples));
      *out.ray_of_sample.row(begin + k) = static_cast<std::int32_t>(ray);
    }
  }
  fill_unused_rows(out, near_far.rows);
}

void sample(const StratifiedArgs& args, View<const double> near_far, Samples<float>& out) {
  out.count = near_far.rows * args.samples;
  if (near_far.rows == 0) return;
  queue_offsets(BinsOfRay{near_far, static_cast<std::int32_t>(args.samples)}, near_far.rows, out.first);
  sample_kernel<<<blocks_of(near_far.rows, kRaysPerBlock), kThreads, 0, launch().stream>>>(args, near_far, out,
                                                                                           launch().cell);
  check_launch("stratified sample");
  throw_bad_limits(near_far, args.first_ray);
}

const StratifiedKernels<float> kTable{sample};

}  // namespace

void stratified_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "sampler 'stratified'", &kTable); }

}  // namespace semfield::cuda
