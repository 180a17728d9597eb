// What tests of kernels for NVIDIA GPUs share: matrices in device memory whose surroundings are watched, a launch
// with its own stream, step numbers and fault cell, and test data.
#pragma once

#include <cuda_runtime_api.h>
#include <gtest/gtest.h>

#include <cstring>
#include <initializer_list>
#include <optional>

#include "core/rng.h"
#include "core/view.h"
#include "core/workspace.h"
#include "cuda/launch.h"
#include "cuda/memory.h"
#include "plugin/kernels.h"

namespace semfield::testing {

inline bool has_device() {
  static const bool found = [] {
    int count = 0;
    return cudaGetDeviceCount(&count) == cudaSuccess && count > 0;
  }();
  return found;
}

/// First line of every test that launches a kernel.
#define SEMFIELD_NEEDS_DEVICE()                                           \
  if (!::semfield::testing::has_device())                                 \
  GTEST_SKIP() << "this machine has no NVIDIA GPU that its driver " \
                  "offers"
/// The same, with a launch of that name.
#define SEMFIELD_ON_DEVICE(launch) \
  SEMFIELD_NEEDS_DEVICE();         \
  ::semfield::testing::DeviceLaunch launch

/// What these functions add: `x_kernels` of plugins, cuda::add_plugin_kernels.
inline KernelTables tables_of(std::initializer_list<void (*)(KernelTables&)> adders) {
  KernelTables tables;
  for (const auto add : adders) add(tables);
  return tables;
}

/// A row-major matrix in device memory. Gaps between rows, and some elements behind the last, are filled with one bits
/// (NaN in float, -1 in integers), and so is a matrix that was given no values: what a kernel must write is seen, and
/// what it must not write too.
template <class T>
class DeviceMatrix {
 public:
  DeviceMatrix(std::int64_t rows, std::int32_t cols, std::int64_t row_stride = -1)
      : rows_(rows), cols_(cols), stride_(row_stride < 0 ? cols : row_stride) {
    void* memory = nullptr;
    cuda::check(cudaMalloc(&memory, bytes()), "memory of a test");
    data_ = static_cast<T*>(memory);
    cuda::check(cudaMemset(data_, 0xFF, bytes()), "memory of a test");
  }
  /// `values` row by row without gaps.
  template <class U>
  DeviceMatrix(const std::vector<U>& values, std::int32_t cols, std::int64_t row_stride = -1)
      : DeviceMatrix(cols == 0 ? 0 : static_cast<std::int64_t>(values.size()) / cols, cols, row_stride) {
    write(values);
  }
  DeviceMatrix(const DeviceMatrix&) = delete;
  DeviceMatrix& operator=(const DeviceMatrix&) = delete;
  ~DeviceMatrix() { (void)cudaFree(data_); }

  View<T> view() const { return View<T>(data_, rows_, cols_, stride_, Device::cuda); }
  View<const T> read_only() const { return view(); }
  T* data() const { return data_; }

  template <class U>
  void write(const std::vector<U>& values) {
    std::vector<T> all = whole();
    for (std::int64_t i = 0; i < rows_ * cols_; ++i) all[i / cols_ * stride_ + i % cols_] = static_cast<T>(values[i]);
    cuda::check(cudaMemcpy(data_, all.data(), bytes(), cudaMemcpyHostToDevice), "copying to the device");
  }
  /// Waits for the device; row by row without gaps.
  std::vector<T> read() const {
    const std::vector<T> all = whole();
    std::vector<T> values;
    for (std::int64_t i = 0; i < rows_ * cols_; ++i) values.push_back(all[i / cols_ * stride_ + i % cols_]);
    return values;
  }
  /// "" when nothing outside rows and columns was written, else where.
  std::string surroundings() const {
    const std::vector<T> all = whole();
    const T untouched = ones();
    for (std::size_t i = 0; i < all.size(); ++i) {
      const auto at = static_cast<std::int64_t>(i);
      if (at < rows_ * stride_ && at % stride_ < cols_) continue;
      if (std::memcmp(&all[i], &untouched, sizeof(T)) == 0) continue;
      return "element " + std::to_string(i) + " of a " + std::to_string(rows_) + " x " + std::to_string(cols_) +
             " matrix of row stride " + std::to_string(stride_) + " was written";
    }
    return "";
  }

 private:
  static constexpr std::int64_t kBehind = 64;
  static T ones() {
    T value;
    std::memset(static_cast<void*>(&value), 0xFF, sizeof(T));
    return value;
  }
  std::size_t bytes() const { return static_cast<std::size_t>(rows_ * stride_ + kBehind) * sizeof(T); }
  std::vector<T> whole() const {
    std::vector<T> all(static_cast<std::size_t>(rows_ * stride_ + kBehind));
    cuda::check(cudaDeviceSynchronize(), "running the kernels of a test");
    cuda::check(cudaMemcpy(all.data(), data_, bytes(), cudaMemcpyDeviceToHost), "copying from the device");
    return all;
  }
  T* data_ = nullptr;
  std::int64_t rows_ = 0;
  std::int32_t cols_ = 0;
  std::int64_t stride_ = 0;
};

struct NotedFault {
  cuda::Stage stage;
  std::int64_t row;
  bool operator==(const NotedFault&) const = default;
};

/// While it lives, launches of this thread go to a stream of its own, with its own step cell, fault cell and arena.
class DeviceLaunch {
 public:
  explicit DeviceLaunch(bool check_at_once = false, bool deterministic = false) : cell_(1, 1), fault_(1, 1) {
    cuda::check(cudaStreamCreate(&launch_.stream), "a stream of a test");
    launch_.cell = cell_.data();
    launch_.fault = fault_.data();  // one bits are kNoFault
    launch_.check_at_once = check_at_once;
    launch_.deterministic = deterministic;
    set_cell({});
  }
  DeviceLaunch(const DeviceLaunch&) = delete;
  DeviceLaunch& operator=(const DeviceLaunch&) = delete;
  ~DeviceLaunch() {
    scope_.reset();
    (void)cudaStreamDestroy(launch_.stream);
  }

  void set_cell(const cuda::StepCell& cell) {
    cell_.write(std::vector<cuda::StepCell>{cell});
    make_current();
  }
  void set_deterministic(bool deterministic) {
    launch_.deterministic = deterministic;
    make_current();
  }
  /// Rows of the batch that are in use; null: all.
  void set_live_rows(const std::int32_t* live_rows) {
    launch_.live_rows = live_rows;
    make_current();
  }
  /// Waits for the device and takes the fault out of the cell.
  std::optional<NotedFault> take_fault() {
    const cuda::FaultKey key = fault_.read()[0];
    fault_.write(std::vector<cuda::FaultKey>{cuda::kNoFault});
    if (key == cuda::kNoFault) return std::nullopt;
    constexpr cuda::FaultKey kRows = (cuda::FaultKey{1} << cuda::kFaultRowBits) - 1;
    return NotedFault{static_cast<cuda::Stage>(key >> cuda::kFaultRowBits), static_cast<std::int64_t>(key & kRows)};
  }
  void set_fault(cuda::FaultKey key) { fault_.write(std::vector<cuda::FaultKey>{key}); }
  cudaStream_t stream() const { return launch_.stream; }
  Workspace& arena() { return arena_; }

 private:
  void make_current() {
    scope_.reset();
    scope_.emplace(launch_);
  }
  DeviceMatrix<cuda::StepCell> cell_;
  DeviceMatrix<cuda::FaultKey> fault_;
  cuda::Launch launch_;
  std::optional<cuda::LaunchScope> scope_;
  Workspace arena_{cuda::arena_source()};
};

/// `count` numbers in [low, high), the same for the same seed.
inline std::vector<float> random_floats(std::int64_t count, std::uint64_t seed, double low, double high) {
  std::vector<float> values(static_cast<std::size_t>(count));
  for (std::size_t i = 0; i < values.size(); ++i)
    values[i] = static_cast<float>(low + (high - low) * static_cast<double>(uniform01({seed, 0, 0xC0DAu}, i)));
  return values;
}

/// For an oracle in float64 of the same numbers.
inline std::vector<double> widen(const std::vector<float>& values) { return {values.begin(), values.end()}; }

template <class T>
View<T> host_view(std::vector<T>& values, std::int32_t cols) {
  return View<T>(values.data(), cols == 0 ? 0 : static_cast<std::int64_t>(values.size()) / cols, cols);
}
template <class T>
View<const T> host_view(const std::vector<T>& values, std::int32_t cols) {
  return View<const T>(values.data(), cols == 0 ? 0 : static_cast<std::int64_t>(values.size()) / cols, cols);
}

}  // namespace semfield::testing
