// Device memory: arenas, buffers, and what to say when there is none left.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "core/view.h"
#include "core/workspace.h"

namespace semfield::cuda {

/// Device memory, 256-byte aligned. Throws Error(exhausted): requested, free and total bytes, the buffer's name and
/// three settings that make a run smaller. During a graph capture it is an error too: a step must not allocate.
std::byte* allocate(std::size_t bytes, const char* what);
void release(std::byte* memory) noexcept;

/// The source of device arenas.
BlockSource arena_source();

/// Owned device array; starts as zeros.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(std::size_t count, const char* what);
  ~Buffer();
  Buffer(Buffer&& other) noexcept;
  Buffer& operator=(Buffer&& other) noexcept;
  T* data() const { return data_; }
  std::size_t size() const { return size_; }
  View<T> view(std::int64_t rows, std::int32_t cols) const { return View<T>(data_, rows, cols, cols, Device::cuda); }

 private:
  T* data_ = nullptr;
  std::size_t size_ = 0;
};

/// Copies in launch().stream. `upload` and `download` wait for the copy when the host memory is pageable.
template <class T>
void upload(std::span<const T> from, T* to);
template <class T>
void download(const T* from, std::span<T> to);
/// Waits for the stream.
void synchronize();
/// Of the device's memory, what nobody uses.
std::size_t free_bytes();

}  // namespace semfield::cuda
