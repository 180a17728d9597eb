// Squared colour error on the device, and counts of a pass.
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/losses.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kEach = 16;  // values of a thread

// One thread kEach values, a block apart from each other; 12 B a value. A block's sum in a fixed tree.
__global__ void __launch_bounds__(kThreads) error_kernel(View<const float> color, View<const float> target,
                                                         double slope, View<float> d_color, double* of_block) {
  const std::int64_t size = 3 * color.rows;
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * kThreads * kEach + threadIdx.x;
  double sum = 0;
#pragma unroll 4
  for (int j = 0; j < kEach; ++j) {
    const std::int64_t i = begin + static_cast<std::int64_t>(j) * kThreads;
    if (i >= size) break;
    const std::int64_t r = i / 3;
    const auto c = static_cast<std::int32_t>(i - 3 * r);
    const double error = static_cast<double>(color(r, c)) - static_cast<double>(target(r, c));
    sum += error * error;
    if (!d_color.empty()) d_color(r, c) = static_cast<float>(slope * error);
  }
  sum = block_sum<kThreads>(sum);
  if (threadIdx.x == 0) of_block[blockIdx.x] = sum;
}

// One block; the order of the sum depends on `count` alone.
__global__ void __launch_bounds__(kThreads) total_kernel(const double* of_block, std::int64_t count, double* total) {
  double sum = 0;
  for (std::int64_t i = threadIdx.x; i < count; i += kThreads) sum += of_block[i];
  sum = block_sum<kThreads>(sum);
  if (threadIdx.x == 0) *total = sum;
}

// One block; it stops at the first 4 kThreads samples among which one has density. At most 4 B per sample.
__global__ void __launch_bounds__(kThreads)
    count_kernel(View<const std::int32_t> first, View<const float> sigma, LossSums* sums) {
  const std::int32_t count = first(first.rows - 1, 0);
  int dense = 0;
  for (std::int32_t begin = 0; begin < count && dense == 0; begin += 4 * kThreads) {
    for (int j = 0; j < 4; ++j) {
      const std::int32_t m = begin + j * kThreads + static_cast<std::int32_t>(threadIdx.x);
      if (m < count && sigma(m, 0) > 0) dense = 1;
    }
    dense = __syncthreads_or(dense);
  }
  if (threadIdx.x != 0) return;
  sums->samples = count;
  sums->dense = dense;
}

}  // namespace

void photometric_loss(Workspace& arena, View<const float> color, View<const float> target, double normaliser,
                      View<float> d_color, LossSums* sums) {
  const Workspace::Scope scope(arena);
  const unsigned blocks = blocks_of(3 * color.rows, kThreads * kEach);
  if (blocks == 0) {
    check(cudaMemsetAsync(&sums->squares, 0, sizeof sums->squares, launch().stream), "clearing a sum");
    return;
  }
  double* const of_block = blocks == 1 ? &sums->squares : arena.take<double>(blocks, 1).data;
  error_kernel<<<blocks, kThreads, 0, launch().stream>>>(color, target, 2.0 / normaliser, d_color, of_block);
  check_launch("colour loss");
  if (blocks == 1) return;
  sum_in_order(of_block, blocks, &sums->squares);
}

void sum_in_order(const double* numbers, std::int64_t count, double* total) {
  total_kernel<<<1, kThreads, 0, launch().stream>>>(numbers, count, total);
  check_launch("sum of a loss");
}

void count_samples(View<const std::int32_t> first, View<const float> sigma, LossSums* sums) {
  count_kernel<<<1, kThreads, 0, launch().stream>>>(first, sigma, sums);
  check_launch("counting samples");
}

}  // namespace semfield::cuda
