// Samples that a semantic branch keeps, what its network reads of them, and dropout; points in place of samples.
#include "cuda/kernels/ray_scan.cuh"
#include "cuda/kernels/sampling.cuh"
#include "cuda/stages.h"
#include "model/head_branch.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;

__device__ bool weighs(float weight, float least) { return weight >= least && weight > 0; }

// A thread per ray, 4 B per sample.
struct CountKept {
  View<const std::int32_t> first;
  View<const float> weight;
  float least;
  __device__ std::int32_t operator()(std::int64_t ray, FaultKey*) const {
    std::int32_t count = 0;
    for (std::int32_t m = first(ray, 0); m < first(ray + 1, 0); ++m) count += weighs(weight(m, 0), least) ? 1 : 0;
    return count;
  }
};

// A warp per ray: 4 B read per sample, 24 B moved a kept one. The sum of weights in a fixed tree.
__global__ void __launch_bounds__(kRayThreads)
    keep_kernel(Samples<float> samples, View<const float> weight, float least, BranchTrace<float> kept) {
  fill_unused_rows(kept.samples, kept.share.rows);
  const std::int64_t thread = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const std::int64_t threads = static_cast<std::int64_t>(gridDim.x) * blockDim.x;
  for (std::int64_t k = kept.samples.first(kept.share.rows, 0) + thread; k < kept.samples.count; k += threads) {
    kept.source(k, 0) = 0;
    kept.weight(k, 0) = 0;
  }
  const WarpRay at(samples.first);
  if (at.ray >= kept.share.rows) return;
  std::int32_t next = kept.samples.first(at.ray, 0);
  float share = 0;
  for (std::int32_t base = at.begin; base < at.end; base += kWarp) {
    const std::int32_t m = base + at.lane;
    const float w = m < at.end ? weight(m, 0) : 0.0F;
    const bool keeps = m < at.end && weighs(w, least);
    const unsigned all = __ballot_sync(kFullMask, keeps);
    if (keeps) {
      const std::int32_t k = next + __popc(all & ((1U << at.lane) - 1));
      kept.samples.t(k, 0) = samples.t(m, 0);
      kept.samples.delta(k, 0) = samples.delta(m, 0);
      kept.samples.ray_of_sample(k, 0) = static_cast<std::int32_t>(at.ray);
      kept.source(k, 0) = m;
      kept.weight(k, 0) = w;
      share += w;
    }
    next += __popc(all);
  }
  share = warp_sum(share);
  if (at.lane == 0) kept.share(at.ray, 0) = share;
}

// A warp a row of the input, 8 B a value.
__global__ void __launch_bounds__(kThreads)
    join_kernel(BranchTrace<float> trace, View<const float> position, View<const float> feature) {
  const std::int64_t k = (static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp;
  if (k >= trace.input.rows) return;
  const bool live = k < trace.samples.first(trace.share.rows, 0);
  const std::int64_t source = live ? trace.source(k, 0) : 0;
  for (std::int32_t c = static_cast<std::int32_t>(threadIdx.x) % kWarp; c < trace.input.cols; c += kWarp) {
    float value = 0;
    if (live) value = c < position.cols ? position(k, c) : feature(source, c - position.cols);
    trace.input(k, c) = value;
  }
}

// A thread kDropoutGroup values of a row, 8 B each.
__global__ void __launch_bounds__(kThreads)
    dropout_kernel(Dropout rule, Samples<float> samples, View<const float> from, View<float> to, const StepCell* cell) {
  const std::int64_t at = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const std::int32_t groups = (to.cols + kDropoutGroup - 1) / kDropoutGroup;
  const std::int64_t k = at / groups;
  const auto group = static_cast<std::int32_t>(at % groups);
  if (k >= to.rows) return;
  const std::int32_t begin = group * kDropoutGroup;
  const bool live = k < samples.first(samples.first.rows - 1, 0);
  DropoutFactors factors{};
  if (live) {
    const std::int32_t ray = samples.ray_of_sample(k, 0);
    factors = dropout_factors(at_step(rule.random, cell), rule.share, rule.first_ray + ray, k - samples.first(ray, 0),
                              group, to.cols);
  }
  for (std::int32_t i = 0; i < kDropoutGroup && begin + i < to.cols; ++i)
    to(k, begin + i) = live ? from(k, begin + i) * factors.of[i] : 0.0F;
}

__global__ void __launch_bounds__(kThreads) count_kernel(View<std::int32_t> numbers) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < numbers.rows) numbers(i, 0) = static_cast<std::int32_t>(i);
}

// A warp per point; 8 B per number of its row.
__global__ void __launch_bounds__(kThreads)
    choose_kernel(View<const std::int32_t> choice, View<const float> from, View<const std::int16_t> logit,
                  View<float> to, View<std::int16_t> to_logit) {
  const std::int64_t i = (static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp;
  if (i >= to.rows) return;
  const std::int64_t point = choice(i, 0);
  const auto lane = static_cast<std::int32_t>(threadIdx.x % kWarp);
  for (std::int32_t c = lane; c < to.cols; c += kWarp) to(i, c) = from(point, c);
  if (lane == 0) to_logit(i, 0) = logit(point, 0);
}

}  // namespace

void keep_samples(const Samples<float>& samples, View<const float> weight, float least,
                  const BranchTrace<float>& kept) {
  const std::int64_t rays = kept.share.rows;
  if (rays == 0) return;
  queue_offsets(CountKept{samples.first, weight, least}, rays, kept.samples.first);
  keep_kernel<<<ray_blocks(rays), kRayThreads, 0, launch().stream>>>(samples, weight, least, kept);
  check_launch("samples of a semantic branch");
}

void join_inputs(const BranchTrace<float>& trace, View<const float> position, View<const float> feature) {
  if (trace.input.size() == 0) return;
  join_kernel<<<blocks_of(trace.input.rows * kWarp, kThreads), kThreads, 0, launch().stream>>>(trace, position,
                                                                                               feature);
  check_launch("inputs of a semantic branch");
}

void drop_out(const Dropout& rule, const Samples<float>& samples, View<const float> from, View<float> to) {
  if (to.size() == 0) return;
  const std::int64_t groups = to.rows * ((to.cols + kDropoutGroup - 1) / kDropoutGroup);
  dropout_kernel<<<blocks_of(groups, kThreads), kThreads, 0, launch().stream>>>(rule, samples, from, to, launch().cell);
  check_launch("dropout");
}

void count_up(View<std::int32_t> numbers) {
  if (numbers.rows == 0) return;
  count_kernel<<<blocks_of(numbers.rows, kThreads), kThreads, 0, launch().stream>>>(numbers);
  check_launch("numbers of rows");
}

void choose_points(View<const std::int32_t> choice, View<const float> from, View<const std::int16_t> logit,
                   View<float> to, View<std::int16_t> to_logit) {
  if (to.rows == 0) return;
  choose_kernel<<<blocks_of(to.rows * kWarp, kThreads), kThreads, 0, launch().stream>>>(choice, from, logit, to,
                                                                                        to_logit);
  check_launch("points of a lesson");
}

}  // namespace semfield::cuda
