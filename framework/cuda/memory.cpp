#include "cuda/memory.h"

#include <fmt/format.h>

#include <utility>

#include "core/error.h"
#include "cuda/launch.h"

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

}  // namespace semfield::cuda
