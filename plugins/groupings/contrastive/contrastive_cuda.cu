// The contrastive loss on the device: a warp per point that asks, its lanes over the numbers of an embedding.
#include "cuda/kernels/device_code.cuh"
#include "groupings/contrastive/contrastive.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 128;
constexpr int kOfLane = 2;  // numbers of an embedding: dims is at most 64

// What a warp knows of its point: each lane some numbers of the embedding and of sums over keys.
struct Asking {
  const GroupingCall& call;
  std::int64_t first_row;  // of the image
  std::int32_t own;        // segment
  int lane;
  float q[kOfLane];

  __device__ Asking(const GroupingCall& c, std::int64_t image, std::int64_t row)
      : call(c), first_row(image * c.per_image), own(c.segment(row, 0)), lane(threadIdx.x % kWarp) {
    for (int t = 0; t < kOfLane; ++t) q[t] = has(t) ? call.rows(row, dim(t)) : 0;
  }
  __device__ int dim(int t) const { return lane + kWarp * t; }
  __device__ bool has(int t) const { return dim(t) < call.rows.cols; }
  __device__ std::int64_t key_row(std::int64_t j) const { return first_row + 2 * j + 1; }
  __device__ bool is_own(std::int64_t j) const { return call.segment(key_row(j), 0) == own; }
  __device__ float key(std::int64_t j, int t) const { return has(t) ? call.slow(key_row(j), dim(t)) : 0; }
  /// -|q - k_j|^2, in every lane.
  __device__ float score(std::int64_t j) const {
    float sum = 0;
    for (int t = 0; t < kOfLane; ++t) {
      const float way = q[t] - key(j, t);
      sum += way * way;
    }
    return -warp_sum(sum);
  }
};

// As contrastive_point() for every point at an even place of its image.
__global__ void __launch_bounds__(kThreads) contrastive_kernel(GroupingCall call, double gather) {
  const std::int64_t keys = call.per_image / 2;
  const std::int64_t number = (static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp;
  if (number >= call.segments.rows * keys) return;
  const std::int64_t image = number / keys, row = image * call.per_image + 2 * (number % keys);
  const Asking at(call, image, row);
  float most = -INFINITY, most_own = -INFINITY;
  std::int64_t same = 0;
  double mean[kOfLane] = {};
  for (std::int64_t j = 0; j < keys; ++j) {
    const float s = at.score(j);
    most = fmaxf(most, s);
    if (!at.is_own(j)) continue;
    ++same;
    most_own = fmaxf(most_own, s);
    for (int t = 0; t < kOfLane; ++t) mean[t] += static_cast<double>(at.key(j, t));
  }
  if (same == 0) return;
  const double share = 1 / static_cast<double>(same);
  double all = 0, own = 0;
  for (std::int64_t j = 0; j < keys; ++j) {
    const float s = at.score(j);
    all += static_cast<double>(expf(s - most));
    if (at.is_own(j)) own += static_cast<double>(expf(s - most_own));
  }
  const double log_all = static_cast<double>(most) + log(all), log_own = static_cast<double>(most_own) + log(own);
  float slope[kOfLane] = {};
  for (std::int64_t j = 0; j < keys; ++j) {
    const auto s = static_cast<double>(at.score(j));
    const bool is_own = at.is_own(j);
    const double change = exp(s - log_all) - (is_own ? exp(s - log_own) : 0);
    const auto factor = static_cast<float>(call.scale * (-2 * change + (is_own ? 2 * gather * share : 0)));
    for (int t = 0; t < kOfLane; ++t) slope[t] += factor * (at.q[t] - at.key(j, t));
  }
  double pull = 0;
  for (int t = 0; t < kOfLane; ++t) {
    if (!at.has(t)) continue;
    call.gradients(row, at.dim(t)) += slope[t];
    const double way = static_cast<double>(at.q[t]) - mean[t] * share;
    pull += way * way;
  }
  pull = warp_sum(pull);
  if (at.lane == 0 && !call.loss.empty()) call.loss(row, 0) = log_all - log_own + (gather > 0 ? gather * pull : 0);
}

void add(const Grouping& grouping, const GroupingCall& call, Workspace&) {
  const std::int64_t asking = call.segments.rows * (call.per_image / 2);
  if (asking == 0) return;
  contrastive_kernel<<<blocks_of(asking * kWarp, kThreads), kThreads, 0, launch().stream>>>(
      call, static_cast<const Contrastive&>(grouping).gather);
  check_launch("contrastive loss");
}

const GroupingKernels<Contrastive> kTable{add};

}  // namespace

void contrastive_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "grouping 'contrastive'", &kTable); }

}  // namespace semfield::cuda
