// Rendering and density queries: a batch is cut into chunks, whose results are waited for at the end.
#include <fmt/format.h>

#include <algorithm>

#include "core/error.h"
#include "cuda/stream_executor.h"
#include "execution/lane_executor.h"

namespace semfield::cuda {

namespace {

constexpr std::int64_t kFewestRays = 256;
constexpr std::int64_t kChunkPositions = std::int64_t{1} << 20;

}  // namespace

Launch StreamExecutor::render_launch() const {
  Launch next;
  next.ordinal = options_.ordinal;
  next.stream = stream_;
  next.fault = render_fault_.data();
  return next;
}

void StreamExecutor::render(const RenderJob<float>& job) {
  guard_rays<float>({job.origin, job.direction, job.near_far}, {}, 0);
  const LaunchScope scope(render_launch());
  check(cudaMemsetAsync(render_fault_.data(), 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
  for (std::int64_t begin = 0; begin < job.origin.rows;) {
    const std::int64_t count = std::min(chunk_rays_, job.origin.rows - begin);
    try {
      const Workspace::Scope chunk(render_arena_);
      StepContext ctx = context(0, false, render_arena_);
      ctx.first_ray = begin;
      render_rays(passes_, host_.per_ray(), job.rows(begin, count), ctx);
      synchronize();
    } catch (const Error& error) {
      if (error.kind() != ErrorKind::unavailable || chunk_rays_ <= kFewestRays) throw;
      chunk_rays_ /= 2;
      synchronize();
      render_arena_.forget();
      continue;
    }
    begin += count;
  }
  explain_fault([&] { host_.lanes().render(job); });
}

void StreamExecutor::density(View<const double> positions, View<float> sigma) {
  const LaunchScope scope(render_launch());
  check(cudaMemsetAsync(render_fault_.data(), 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
  for (std::int64_t begin = 0; begin < positions.rows; begin += kChunkPositions) {
    const Workspace::Scope chunk(render_arena_);
    const std::int64_t count = std::min(kChunkPositions, positions.rows - begin);
    query_density(passes_.back(), positions.row_range(begin, count), sigma.row_range(begin, count),
                  context(0, false, render_arena_));
  }
  explain_fault([&] { host_.lanes().density(positions, sigma); });
}

// A value that is not finite: the CPU makes the call again and names ray and stage.
void StreamExecutor::explain_fault(const std::function<void()>& on_the_host) {
  FaultKey key = kNoFault;
  cuda::download<FaultKey>(render_fault_.data(), {&key, 1});
  synchronize();
  if (key == kNoFault) return;
  download(0);
  on_the_host();
  throw Error(ErrorKind::failure, "device.value.not_finite",
              fmt::format("the device met a value that is not finite (stage {}, row {}) where the CPU meets none",
                          key >> kFaultRowBits, key & ((FaultKey{1} << kFaultRowBits) - 1)),
              "set runtime.precision: fp32 or runtime.device: cpu, and report this");
}

}  // namespace semfield::cuda
