// A borrowed, strided, row-major matrix: the only array type that crosses a component border.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <type_traits>

// The only place that tests for the CUDA compiler: formulas marked SEMFIELD_HD compile for host and device alike.
#ifdef __CUDACC__
#define SEMFIELD_HD __host__ __device__
#elif defined(SEMFIELD_KERNEL_FILE)
// Compiled once per instruction set: no copy of a formula may be shared with other files (compute/isa.h).
#define SEMFIELD_HD __attribute__((always_inline))
#else
#define SEMFIELD_HD
#endif

namespace semfield {

enum class Device : std::uint8_t { cpu, cuda };

/// Borrowed row-major matrix of `rows` x `cols` elements; row r starts at data + r * row_stride (in elements).
/// Never owns; the caller keeps the memory alive. An empty view (data == nullptr) means "not wanted".
template <class T>
struct View {
  T* data = nullptr;
  std::int64_t rows = 0;
  std::int32_t cols = 0;
  std::int64_t row_stride = 0;
  Device device = Device::cpu;

  View() = default;
  SEMFIELD_HD View(T* data_in, std::int64_t rows_in, std::int32_t cols_in, std::int64_t stride_in = -1,
                   Device where = Device::cpu)
      : data(data_in), rows(rows_in), cols(cols_in), row_stride(stride_in < 0 ? cols_in : stride_in), device(where) {}

  /// A view of mutable elements is also a view of constant ones.
  template <class U, std::enable_if_t<std::is_same_v<const U, T> && !std::is_const_v<U>, int> = 0>
  SEMFIELD_HD View(const View<U>& other)  // NOLINT(google-explicit-constructor): borrowing as const is always safe
      : data(other.data), rows(other.rows), cols(other.cols), row_stride(other.row_stride), device(other.device) {}

  SEMFIELD_HD T& operator()(std::int64_t r, std::int32_t c) const { return data[r * row_stride + c]; }
  SEMFIELD_HD T* row(std::int64_t r) const { return data + r * row_stride; }
  SEMFIELD_HD bool empty() const { return data == nullptr; }
  SEMFIELD_HD bool contiguous() const { return row_stride == cols; }
  SEMFIELD_HD std::int64_t size() const { return rows * cols; }
  SEMFIELD_HD View row_range(std::int64_t begin, std::int64_t count) const {
    return View(empty() ? nullptr : data + begin * row_stride, count, cols, row_stride, device);
  }
  SEMFIELD_HD View col_range(std::int32_t begin, std::int32_t count) const {
    return View(empty() ? nullptr : data + begin, rows, count, row_stride, device);
  }
};

// A device of this machine, and how settings name it.

struct DeviceId {
  Device kind = Device::cpu;
  int ordinal = 0;  ///< 0 on the CPU
  bool operator==(const DeviceId&) const = default;
};

/// "cpu", "cuda" (the first one) or "cuda:1"; anything else is no device.
inline std::optional<DeviceId> device_of(std::string_view text) {
  if (text == "cpu") return DeviceId{};
  constexpr std::string_view kCuda = "cuda";
  if (!text.starts_with(kCuda)) return std::nullopt;
  DeviceId id{Device::cuda, 0};
  if (text == kCuda) return id;
  const std::string_view digits = text.substr(kCuda.size() + 1);
  if (text[kCuda.size()] != ':' || digits.empty() || digits.size() > 3) return std::nullopt;
  for (const char digit : digits) {
    if (digit < '0' || digit > '9') return std::nullopt;
    id.ordinal = 10 * id.ordinal + (digit - '0');
  }
  return id;
}

/// What forward leaves for backward; the caller allocates saved_bytes(rows) of it, 64-byte aligned.
using Saved = std::span<std::byte>;

}  // namespace semfield
