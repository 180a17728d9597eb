// The check for values that are not finite.
#include <algorithm>

#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/rendering.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kBlocksPerProcessor = 8;

// Threads stride over the values, four at a time where rows have no gaps; 4 C bytes per row.
__global__ void __launch_bounds__(kThreads)
    guard_kernel(Stage stage, View<const float> values, bool by_fours, FaultKey* fault) {
  const std::int64_t size = values.size(), stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  const std::int64_t thread = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  std::int64_t begin = thread;
  if (by_fours) {
    for (std::int64_t i = thread; i < size / 4; i += stride) {
      const float4 v = reinterpret_cast<const float4*>(values.data)[i];
      const float four[4] = {v.x, v.y, v.z, v.w};
      for (int j = 0; j < 4; ++j) {
        if (!isfinite(four[j])) note_fault(fault, stage, (4 * i + j) / values.cols);
      }
    }
    begin += size / 4 * 4;
  }
  for (std::int64_t i = begin; i < size; i += stride) {
    if (!isfinite(values(i / values.cols, static_cast<std::int32_t>(i % values.cols))))
      note_fault(fault, stage, i / values.cols);
  }
}

}  // namespace

void guard_finite(Stage stage, View<const float> values) {
  if (values.empty() || values.size() == 0) return;
  const bool by_fours = values.contiguous() && reinterpret_cast<std::uintptr_t>(values.data) % alignof(float4) == 0;
  const auto most = static_cast<std::int64_t>(multiprocessors()) * kBlocksPerProcessor * kThreads;
  const std::int64_t accesses = by_fours ? values.size() / 4 + 1 : values.size();
  guard_kernel<<<blocks_of(std::min(accesses, most), kThreads), kThreads, 0, launch().stream>>>(stage, values, by_fours,
                                                                                                launch().fault);
  check_launch("looking for values that are not finite");
}

}  // namespace semfield::cuda
