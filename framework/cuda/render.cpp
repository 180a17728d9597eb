// Rendering and density queries with host memory at both ends.
#include <fmt/format.h>

#include <algorithm>
#include <vector>

#include "core/error.h"
#include "cuda/pipeline.h"
#include "cuda/rendering.h"
#include "model/ray_guard.h"

namespace semfield::cuda {

namespace {

constexpr std::int64_t kFewestRays = 256;
constexpr std::int64_t kChunkPositions = std::int64_t{1} << 20;

// Rows with gaps go one by one, which takes many times longer.
template <class T>
void copy(View<const T> from, View<T> to, cudaMemcpyKind direction, const char* what) {
  const auto bytes = [](std::int64_t elements) { return sizeof(T) * static_cast<std::size_t>(elements); };
  if (from.contiguous() && to.contiguous()) {
    check(cudaMemcpyAsync(to.data, from.data, bytes(from.size()), direction, launch().stream), what);
  } else {
    check(cudaMemcpy2DAsync(to.data, bytes(to.row_stride), from.data, bytes(from.row_stride), bytes(from.cols),
                            static_cast<std::size_t>(from.rows), direction, launch().stream),
          what);
  }
}

// Rows [begin, begin + count) of a host matrix on the device; an empty view stays empty.
template <class T>
View<T> sent(Workspace& arena, View<const T> from, std::int64_t begin, std::int64_t count) {
  if (from.empty()) return {};
  const View<T> to = arena.take<T>(count, from.cols);
  copy<T>(from.row_range(begin, count), to, cudaMemcpyHostToDevice, "sending rays");
  return to;
}

template <class T>
void fetch(View<const T> from, View<T> to, std::int64_t begin) {
  if (to.empty()) return;
  copy<T>(from, to.row_range(begin, from.rows), cudaMemcpyDeviceToHost, "fetching results");
}

template <class T>
View<T> room_for(Workspace& arena, View<T> wanted, std::int64_t count) {
  return wanted.empty() ? View<T>() : arena.take<T>(count, wanted.cols);
}

}  // namespace

Launch DevicePipeline::render_launch() const {
  Launch next;
  next.stream = stream_;
  next.fault = render_fault_.data();
  return next;
}

void DevicePipeline::render(const RenderJob<float>& job) {
  const LaunchScope scope(render_launch());
  check(cudaMemsetAsync(render_fault_.data(), 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
  for (std::int64_t begin = 0; begin < job.origin.rows;) {
    const std::int64_t count = std::min(chunk_rays_, job.origin.rows - begin);
    try {
      render_chunk(job, begin, count);
    } catch (const Error& error) {
      if (error.kind() != ErrorKind::unavailable || chunk_rays_ <= kFewestRays) throw;
      chunk_rays_ /= 2;
      synchronize();
      render_arena_.forget();
      continue;
    }
    begin += count;
  }
  explain_fault([&] { host_.render(job); });
}

void DevicePipeline::density(View<const double> positions, View<float> sigma) {
  const LaunchScope scope(render_launch());
  check(cudaMemsetAsync(render_fault_.data(), 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
  StepContext ctx = context(0, false, render_arena_);
  ctx.pass = passes_.back().parts().number;
  for (std::int64_t begin = 0; begin < positions.rows; begin += kChunkPositions) {
    const Workspace::Scope chunk(render_arena_);
    const std::int64_t count = std::min(kChunkPositions, positions.rows - begin);
    const View<double> x = sent(render_arena_, positions, begin, count);
    const View<float> out = render_arena_.take<float>(count, 1);
    passes_.back().density(ctx, x, out);
    fetch<float>(out, sigma, begin);
  }
  explain_fault([&] { host_.density(positions, sigma); });
}

// A value that is not finite: the processor makes the call again and names ray and stage.
void DevicePipeline::explain_fault(const std::function<void()>& on_the_host) {
  FaultKey key = kNoFault;
  cuda::download<FaultKey>(render_fault_.data(), {&key, 1});
  synchronize();
  if (key == kNoFault) return;
  store_->download();
  host_.derive(0);
  host_.attach(nullptr);
  try {
    on_the_host();
  } catch (...) {
    host_.attach(this);
    throw;
  }
  host_.attach(this);
  throw Error(ErrorKind::failure,
              fmt::format("the device met a value that is not finite (stage {}, row {}) where the processor meets none",
                          key >> kFaultRowBits, key & ((FaultKey{1} << kFaultRowBits) - 1)),
              "set runtime.precision: fp32 or runtime.device: cpu, and report this");
}

void DevicePipeline::render_chunk(const RenderJob<float>& job, std::int64_t begin, std::int64_t count) {
  Workspace& arena = render_arena_;
  const Workspace::Scope chunk(arena);
  StepContext ctx = context(0, false, arena);
  ctx.first_ray = begin;
  Rays<float> rays;
  rays.origin = sent(arena, job.origin, begin, count);
  rays.direction = sent(arena, job.direction, begin, count);
  rays.near_far = sent(arena, job.near_far, begin, count);
  const bool semantics = host_.has_semantics() && !(job.label.empty() && job.entropy.empty() && job.confidence.empty());
  Proposal<float> proposal;
  PassTrace<float> trace;
  for (std::size_t p = 0; p < passes_.size(); ++p) {
    ctx.pass = passes_[p].parts().number;
    const bool last = p + 1 == passes_.size();
    const PassTrace<float> next =
        passes_[p].forward(ctx, kMainGradient, rays, p == 0 ? nullptr : &proposal, p == 0 ? 0 : per_ray_[p - 1],
                           {last && semantics ? count : 0, last});
    trace = next;
    proposal.samples = &trace.samples;
    proposal.weight = trace.weight;
  }
  fetch<float>(trace.color, job.color, begin);
  fetch<float>(trace.depth, job.depth, begin);
  fetch<float>(trace.opacity, job.opacity, begin);
  std::vector<std::int16_t> resolution;
  if (!job.resolution.empty()) {
    const View<std::int16_t> found = arena.take<std::int16_t>(count, 1);
    opacity_resolutions(trace.samples, trace.weight, host_.options().rules.far, job.footprint_per_m, found);
    resolution.resize(static_cast<std::size_t>(count));
    cuda::download<std::int16_t>(found.data, resolution);
  }
  if (semantics) {
    ClassResults results;
    results.truth = sent(arena, job.truth, begin, count);
    results.label = room_for(arena, job.label, count);
    results.entropy = room_for(arena, job.entropy, count);
    results.confidence = room_for(arena, job.confidence, count);
    results.truth_probability = room_for(arena, job.truth_probability, count);
    class_results(trace.logits, results);
    fetch<std::int16_t>(results.label, job.label, begin);
    fetch<float>(results.entropy, job.entropy, begin);
    fetch<float>(results.confidence, job.confidence, begin);
    fetch<float>(results.truth_probability, job.truth_probability, begin);
  }
  synchronize();
  for (std::size_t i = 0; i < resolution.size(); ++i) {
    job.resolution(begin + static_cast<std::int64_t>(i), 0) = static_cast<OpacityResolution>(resolution[i]);
  }
}

}  // namespace semfield::cuda
