// Which settings fit into the device's memory, found by trying: said when a step does not.
#include <fmt/format.h>

#include <algorithm>

#include "core/error.h"
#include "cuda/stream_executor.h"

namespace semfield::cuda {

namespace {

constexpr double kMargin = 0.9;      // of what is free: for graphs, products' workspaces and neighbours
constexpr std::int64_t kRound = 32;  // rays

}  // namespace

void StreamExecutor::forget_step() {
  synchronize();
  check(cudaStreamSynchronize(beside_), "waiting for the device");
  for (Track& track : tracks_) {
    check(cudaStreamSynchronize(track.stream), "waiting for the device");
    track.arena.forget();
  }
  train_arena_.forget();
  beside_arena_.forget();
}

// Forward and backward of the first `rays` rays of each shard; the arenas' high-water marks say what they took.
bool StreamExecutor::fits(std::int64_t rays, const Shape& shape, std::int64_t step) {
  forget_step();
  try {
    sums_->begin(false);
    walk_shards(shape, step, rays);
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::unavailable) throw;
    return false;
  }
  return true;
}

// Halves a shard until it fits; what that took says what a ray takes. Parameters stay as they are.
Error StreamExecutor::with_settings_that_fit(const Error& error, const Shape& shape, std::int64_t step) {
  room_.give_all();
  const std::int64_t rays = tile_rays(rays_), shards = sums_->shards();
  std::int64_t fit = rays / 2;
  while (fit > 0 && !fits(fit, shape, step)) fit /= 2;
  if (fit == 0) return error;
  std::size_t taken = train_arena_.high_water_bytes() + beside_arena_.high_water_bytes();
  for (const Track& track : tracks_) taken += track.arena.high_water_bytes();
  const double each = static_cast<double>(taken) / static_cast<double>(fit);
  forget_step();
  // An arena asks for an eighth more than its high-water mark (core/workspace.h).
  const double most = kMargin * static_cast<double>(free_bytes()) / (1.125 * each);
  std::int64_t more = std::min(static_cast<std::int64_t>(most), rays) / kRound * kRound;
  while (more > fit && !fits(more, shape, step)) more = more * 3 / 4 / kRound * kRound;
  fit = std::max(fit, more);
  forget_step();
  drop_gradients();
  if (fit == rays) {
    return {error.kind(), error.code(), error.message(),
            "other processes held the memory and have freed it: start again; or runtime.device: cpu"};
  }
  return {error.kind(), error.code(), error.message(),
          fmt::format("any of these fits: train.rays: {} (now {}); {:.2f} times the samples in every pass; "
                      "runtime.device: cpu",
                      fit * shards, rays_, static_cast<double>(fit) / static_cast<double>(rays))};
}

}  // namespace semfield::cuda
