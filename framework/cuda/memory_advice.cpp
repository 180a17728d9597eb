// Which settings fit into the device's memory, found by trying: said when a step does not.
#include <fmt/format.h>

#include <algorithm>

#include "core/error.h"
#include "cuda/stream_executor.h"

namespace semfield::cuda {

namespace {

constexpr double kMargin = 0.9;      // of what is free: for graphs, products' workspaces and neighbours
constexpr std::int64_t kRound = 32;  // rays

RayBatch first_rays(const RayBatch& batch, std::int64_t rays) {
  const auto first = [rays](const auto& view) { return view.row_range(0, rays); };
  RayBatch out;
  out.origin = first(batch.origin);
  out.direction = first(batch.direction);
  out.near_far = first(batch.near_far);
  out.target = first(batch.target);
  if (!batch.label.empty()) out.label = first(batch.label);
  if (!batch.soft.empty()) out.soft = first(batch.soft);
  if (!batch.depth.empty()) out.depth = first(batch.depth);
  out.label_only_share = batch.label_only_share;
  return out;
}

}  // namespace

void StreamExecutor::forget_step() {
  synchronize();
  check(cudaStreamSynchronize(beside_), "waiting for the device");
  train_arena_.forget();
  beside_arena_.forget();
}

// Forward and backward of the first `rays` rays; the arena's high-water mark says what they took.
bool StreamExecutor::fits(std::int64_t rays, const Shape& shape, std::int64_t step) {
  forget_step();
  try {
    const Workspace::Scope scope(train_arena_), beside(beside_arena_);
    const Shape smaller{std::min(shape.semantic_rays, rays), shape.terms};
    train_passes(smaller, first_rays(staging_->batch(), rays), context(step, true, train_arena_));
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::unavailable) throw;
    return false;
  }
  return true;
}

// Halves the batch until it fits; what that took says what a ray takes. Parameters stay as they are.
Error StreamExecutor::with_settings_that_fit(const Error& error, const Shape& shape, std::int64_t step) {
  const std::int64_t rays = staging_->batch().origin.rows;
  std::int64_t fit = rays / 2;
  while (fit > 0 && !fits(fit, shape, step)) fit /= 2;
  if (fit == 0) return error;
  const std::size_t taken = train_arena_.high_water_bytes() + beside_arena_.high_water_bytes();
  const double each = static_cast<double>(taken) / static_cast<double>(fit);
  forget_step();
  // An arena asks for an eighth more than its high-water mark (core/workspace.h).
  const double most = kMargin * static_cast<double>(free_bytes()) / (1.125 * each);
  std::int64_t more = std::min(static_cast<std::int64_t>(most), rays) / kRound * kRound;
  while (more > fit && !fits(more, shape, step)) more = more * 3 / 4 / kRound * kRound;
  fit = std::max(fit, more);
  forget_step();
  store_->clear_gradients();
  check(cudaMemsetAsync(&staging_->device_sums()->fault, 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
  if (fit == rays) {
    return {error.kind(), error.message(),
            "other processes held the memory and have freed it: start again; or runtime.device: cpu"};
  }
  return {error.kind(), error.message(),
          fmt::format("any of these fits: train.rays: {} (now {}); {:.2f} times the samples in every pass; "
                      "runtime.device: cpu",
                      fit, rays, static_cast<double>(fit) / static_cast<double>(rays))};
}

}  // namespace semfield::cuda
