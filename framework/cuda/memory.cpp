#include "cuda/memory.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "core/error.h"
#include "cuda/launch.h"
#include "cuda/stream_executor.h"

namespace semfield::cuda {

namespace {

constexpr double kMega = 1e6;

std::byte* arena_block(std::size_t bytes) { return allocate(bytes, "activations of a step"); }
void arena_release(std::byte* block) { release(block); }

}  // namespace

std::byte* allocate(std::size_t bytes, const char* what) {
  void* memory = nullptr;
  const cudaError_t status = cudaMalloc(&memory, bytes);
  if (status == cudaErrorMemoryAllocation) {
    (void)cudaGetLastError();  // this error is answered here and must not come back at the next launch
    std::size_t unused = 0, total = 0;
    (void)cudaMemGetInfo(&unused, &total);
    throw Error(ErrorKind::unavailable, "memory.device.full",
                fmt::format("CUDA: no device memory for '{}': requested {:.1f} MB, free {:.1f} MB of {:.1f} MB", what,
                            static_cast<double>(bytes) / kMega, static_cast<double>(unused) / kMega,
                            static_cast<double>(total) / kMega),
                "lower train.rays, take fewer samples per ray, or set runtime.precision: bf16");
  }
  check(status, what);
  return static_cast<std::byte*>(memory);
}

void release(std::byte* memory) noexcept {
  if (memory != nullptr) (void)cudaFree(memory);
}

BlockSource arena_source() { return {Device::cuda, arena_block, arena_release}; }

template <class T>
Buffer<T>::Buffer(std::size_t count, const char* what) : size_(count) {
  if (count == 0) return;
  data_ = reinterpret_cast<T*>(allocate(count * sizeof(T), what));
  // Queued on the default stream, for which the streams of pipelines do not wait.
  check(cudaMemset(data_, 0, count * sizeof(T)), what);
  check(cudaStreamSynchronize(nullptr), what);
}
template <class T>
Buffer<T>::~Buffer() {
  release(reinterpret_cast<std::byte*>(data_));
}
template <class T>
Buffer<T>::Buffer(Buffer&& other) noexcept
    : data_(std::exchange(other.data_, nullptr)), size_(std::exchange(other.size_, 0)) {}
template <class T>
Buffer<T>& Buffer<T>::operator=(Buffer&& other) noexcept {
  std::swap(data_, other.data_);
  std::swap(size_, other.size_);
  return *this;
}

template <class T>
void upload(std::span<const T> from, T* to) {
  if (from.empty()) return;
  check(cudaMemcpyAsync(to, from.data(), from.size_bytes(), cudaMemcpyHostToDevice, launch().stream),
        "copying to the device");
}
template <class T>
void download(const T* from, std::span<T> to) {
  if (to.empty()) return;
  check(cudaMemcpyAsync(to.data(), from, to.size_bytes(), cudaMemcpyDeviceToHost, launch().stream),
        "copying from the device");
}
std::size_t free_bytes() {
  std::size_t unused = 0, total = 0;
  check(cudaMemGetInfo(&unused, &total), "asking for free memory");
  return unused;
}
void synchronize() { check(cudaStreamSynchronize(launch().stream), "waiting for the device"); }

#define SEMFIELD_INSTANTIATE(T)                    \
  template class Buffer<T>;                        \
  template void upload<T>(std::span<const T>, T*); \
  template void download<T>(const T*, std::span<T>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
SEMFIELD_INSTANTIATE(std::byte)
SEMFIELD_INSTANTIATE(std::int16_t)
SEMFIELD_INSTANTIATE(std::int32_t)
SEMFIELD_INSTANTIATE(unsigned long long)
SEMFIELD_INSTANTIATE(StepCell)
#undef SEMFIELD_INSTANTIATE

// Which settings fit into the device's memory, found by trying: said when a step does not.

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
