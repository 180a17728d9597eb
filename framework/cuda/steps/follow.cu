// A slow copy follows: 12 B per number.
#include "cuda/grouping_lessons.h"
#include "cuda/launch.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    follow_kernel(const float* value, float* slow, std::int64_t count, float kept, float taken) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < count) slow[i] = kept * slow[i] + taken * value[i];
}

}  // namespace

void follow(std::span<const float> value, std::span<float> slow, double share) {
  const auto count = static_cast<std::int64_t>(slow.size());
  follow_kernel<<<blocks_of(count, kThreads), kThreads, 0, launch().stream>>>(
      value.data(), slow.data(), count, static_cast<float>(share), static_cast<float>(1 - share));
  check_launch("slow copy of a network");
}

}  // namespace semfield::cuda
