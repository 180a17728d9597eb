// What tests of kernels for NVIDIA GPUs share: matrices in device memory whose surroundings are watched, a launch
// with its own stream, step numbers and fault cell, and test data.
#pragma once

#include <cuda_bf16.h>
#include <cuda_runtime_api.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <optional>
#include <type_traits>
#include <vector>

#include "core/non_copyable.h"
#include "core/rng.h"
#include "core/view.h"
#include "core/workspace.h"
#include "cuda/launch.h"
#include "execution/device_library.h"
#include "plugin/field.h"
#include "plugin/kernels.h"
#include "plugin/loader.h"
#include "testkit/benches.h"
#include "testkit/compare.h"

namespace semfield::testing {

inline int device_count() {
  static const int found = [] {
    int count = 0;
    return cudaGetDeviceCount(&count) == cudaSuccess ? count : 0;
  }();
  return found;
}
inline bool has_device() { return device_count() > 0; }

/// First line of a test that launches a kernel, where its suite is no DeviceTest.
#define SEMFIELD_NEEDS_DEVICE()                                     \
  if (!::semfield::testing::has_device())                           \
  GTEST_SKIP() << "this machine has no NVIDIA GPU that its driver " \
                  "offers"
/// The same, with a launch of that name.
#define SEMFIELD_ON_DEVICE(launch) \
  SEMFIELD_NEEDS_DEVICE();         \
  ::semfield::testing::DeviceLaunch launch

/// Of suites whose every test launches a kernel.
class DeviceTest : public ::testing::Test {
 protected:
  void SetUp() override { SEMFIELD_NEEDS_DEVICE(); }
};

/// Every plugin of the build, with its kernels for the device.
inline const Registry& registry_with_cuda() {
  static const Registry registry = [] {
    Registry filled;
    register_linked_plugins(filled);
    cuda_library().add_kernels(filled.kernels());
    return filled;
  }();
  return registry;
}

inline const KernelTables& all_kernels() { return registry_with_cuda().kernels(); }

/// A row-major matrix in device memory. Gaps between rows, and some elements behind the last, are filled with one bits
/// (NaN in float, -1 in integers), and so is a matrix that was given no values: what a kernel must write is seen, and
/// what it must not write too.
template <class T>
class DeviceMatrix : NonCopyable {
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
class DeviceLaunch : NonCopyable {
 public:
  explicit DeviceLaunch(bool check_at_once = false, bool deterministic = false) : cell_(1, 1), fault_(1, 1) {
    cuda::check(cudaStreamCreate(&launch_.stream), "a stream of a test");
    launch_.cell = cell_.data();
    launch_.fault = fault_.data();  // one bits are kNoFault
    launch_.check_at_once = check_at_once;
    launch_.deterministic = deterministic;
    set_cell({});
  }
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

/// Values of a view of device memory without gaps.
template <class T>
std::vector<std::remove_const_t<T>> there(View<T> view) {
  std::vector<std::remove_const_t<T>> values(static_cast<std::size_t>(view.size()));
  cuda::download<std::remove_const_t<T>>(view.data, values);
  cuda::synchronize();
  return values;
}

inline void expect_near(double got, double want, double relative, const std::string& what) {
  EXPECT_NEAR(got, want, relative * std::max(1e-6, std::abs(want))) << what;
}

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
std::vector<double> widen(const DeviceMatrix<T>& matrix) {
  std::vector<double> wide;
  for (const T& value : matrix.read()) wide.push_back(static_cast<double>(static_cast<float>(value)));
  return wide;
}

template <class T>
View<T> host_view(std::vector<T>& values, std::int32_t cols) {
  return View<T>(values.data(), cols == 0 ? 0 : static_cast<std::int64_t>(values.size()) / cols, cols);
}
template <class T>
View<const T> host_view(const std::vector<T>& values, std::int32_t cols) {
  return View<const T>(values.data(), cols == 0 ? 0 : static_cast<std::int64_t>(values.size()) / cols, cols);
}

/// The numbers of a view, row by row.
template <class Real>
std::vector<float> flat(View<Real> view) {
  std::vector<float> values;
  for (std::int64_t r = 0; r < view.rows; ++r) {
    for (std::int32_t c = 0; c < view.cols; ++c) values.push_back(static_cast<float>(view(r, c)));
  }
  return values;
}

/// A component's tensors in device memory, and gradients that are zeros.
struct DeviceTensors {
  template <class Real>
  explicit DeviceTensors(const testkit::TensorBox<Real>& box) {
    for (std::size_t i = 0; i < box.count(); ++i) {
      const View<Real> value = box.value(i);
      const std::vector<float> zeros(static_cast<std::size_t>(value.size()));
      values.push_back(std::make_unique<DeviceMatrix<float>>(flat(value), value.cols));
      grads.push_back(std::make_unique<DeviceMatrix<float>>(zeros, value.cols));
      value_views.push_back(values.back()->view());
      grad_views.push_back(grads.back()->view());
    }
  }
  Tensors<float> tensors() const { return {value_views, grad_views}; }
  Tensors<float> values_only() const { return {value_views, {}}; }
  void clear_gradients() const {
    for (const auto& grad : grads) grad->write(std::vector<float>(static_cast<std::size_t>(grad->view().size())));
  }
  std::vector<std::vector<float>> gradients() const {
    std::vector<std::vector<float>> all;
    for (const auto& grad : grads) all.push_back(grad->read());
    return all;
  }
  std::string surroundings() const {
    std::string all;
    for (const auto* tensors_of : {&values, &grads})
      for (const auto& tensor : *tensors_of) all += tensor->surroundings();
    return all;
  }
  std::vector<std::unique_ptr<DeviceMatrix<float>>> values, grads;
  std::vector<View<float>> value_views, grad_views;
};

// A field on the device with the inputs, tensors and output weights of a float64 bench on the CPU, its oracle.

using testkit::FieldBench;
using testkit::Wanted;

/// bf16 numbers of the device as the field contract names them.
inline View<Bf16> as_rounded(View<__nv_bfloat16> v) {
  return {reinterpret_cast<Bf16*>(v.data), v.rows, v.cols, v.row_stride, v.device};
}

class DeviceField : public DeviceTensors {
 public:
  /// `padding`: columns between the rows of inputs and outputs.
  DeviceField(const Field<float>& of, FieldBench<double>& bench, std::int32_t padding = 0)
      : DeviceTensors(bench.box), field(of) {
    const std::int64_t rows = bench.position.rows();
    const auto copy = [&](const testkit::Guarded<double>& from) {
      return std::make_unique<DeviceMatrix<float>>(flat(from.view()), from.cols(), from.cols() + padding);
    };
    const auto space = [&](std::int32_t cols) {
      return std::make_unique<DeviceMatrix<float>>(rows, cols, cols + padding);
    };
    position = copy(bench.position);
    if (bench.direction.cols() > 0) direction = copy(bench.direction);
    std::vector<std::int32_t> rays;
    for (std::int64_t m = 0; m < rows; ++m) rays.push_back(bench.ray_of_sample(m, 0));
    ray_of_sample = std::make_unique<DeviceMatrix<std::int32_t>>(rays, 1);
    w_sigma = copy(bench.w_sigma), w_rgb = copy(bench.w_rgb), w_feature = copy(bench.w_feature);
    sigma = space(1), rgb = space(3), feature = space(bench.feature.cols()), d_position = space(bench.position.cols());
    saved = std::make_unique<DeviceMatrix<std::byte>>(
        static_cast<std::int64_t>(field.saved_bytes(rows, direction ? direction->view().rows : 0)), 1);
    ctx.training = true;
    ctx.workspace = &launch.arena();
  }

  FieldIn<float> in() const {
    FieldIn<float> inputs{.position = position->view()};
    if (direction) inputs.direction = direction->view();
    inputs.ray_of_sample = ray_of_sample->view();
    return inputs;
  }
  FieldOut<float> out(Wanted wanted = {}) const {
    FieldOut<float> outputs;
    if (wanted.sigma) outputs.sigma = sigma->view();
    if (wanted.rgb) outputs.rgb = rgb->view();
    if (wanted.feature) outputs.feature = feature->view();
    return outputs;
  }
  FieldGrad<float> weights(Wanted wanted = {}) const {
    FieldGrad<float> w;
    if (wanted.sigma) w.sigma = w_sigma->view();
    if (wanted.rgb) w.rgb = w_rgb->view();
    if (wanted.feature) w.feature = w_feature->view();
    return w;
  }
  Saved space() const { return Saved(saved->data(), static_cast<std::size_t>(saved->view().rows)); }

  void derive() const { field.derive(ctx, tensors()); }
  void forward(Wanted wanted = {}, bool for_backward = true) const {
    field.forward(ctx, tensors(), in(), out(wanted), for_backward ? space() : Saved());
  }
  void backward(Wanted wanted = {}, bool with_d_position = true) const {
    field.backward(ctx, tensors(), in(), out(), weights(wanted), space(),
                   with_d_position ? d_position->view() : View<float>());
    field.derive_backward(ctx, tensors());
  }

  DeviceLaunch launch;
  const Field<float>& field;
  StepContext ctx;
  std::unique_ptr<DeviceMatrix<float>> position, direction, w_sigma, w_rgb, w_feature, sigma, rgb, feature, d_position;
  std::unique_ptr<DeviceMatrix<std::int32_t>> ray_of_sample;
  std::unique_ptr<DeviceMatrix<std::byte>> saved;
};

/// floor: what sums of terms are like whose total may cancel (testkit/compare.h).
template <class T>
std::string near(const DeviceMatrix<T>& got, View<const double> want, double tolerance, double floor = 1e-30) {
  const std::vector<double> values = widen(got);
  return testkit::compare<double, double>(host_view(values, want.cols), want, tolerance, floor);
}
template <class T>
std::string near(const DeviceMatrix<T>& got, const std::vector<double>& want, double tolerance, double floor = 1e-30) {
  return near(got, host_view(want, got.view().cols), tolerance, floor);
}
inline std::string near_norm(const DeviceMatrix<float>& got, View<const double> want, double tolerance) {
  const std::vector<double> values = widen(got);
  return testkit::compare_norms<double, double>(host_view(values, want.cols), want, tolerance);
}
inline std::string near_norm(const DeviceMatrix<float>& got, View<const float> want, double tolerance) {
  const std::vector<float> values = got.read();
  return testkit::compare_norms<float, float>(host_view(values, want.cols), want, tolerance);
}
inline std::string near_norm(const DeviceMatrix<float>& got, const DeviceMatrix<float>& want, double tolerance) {
  const std::vector<double> values = widen(want);
  return near_norm(got, host_view(values, want.view().cols), tolerance);
}

/// The outputs that are wanted against those of a bench.
inline void expect_outputs_near(const DeviceField& device, FieldBench<double>& bench, double tolerance,
                                double floor = 1e-30, Wanted wanted = {}) {
  const auto expect = [&](bool is_wanted, const DeviceMatrix<float>& got, View<const double> want, const char* what) {
    EXPECT_EQ(is_wanted ? near(got, want, tolerance, floor) : "", "") << what;
    EXPECT_EQ(got.surroundings(), "") << what;
  };
  expect(wanted.sigma, *device.sigma, bench.sigma.view(), "sigma");
  expect(wanted.rgb, *device.rgb, bench.rgb.view(), "rgb");
  expect(wanted.feature, *device.feature, bench.feature.view(), "feature");
}
/// Gradients of a bench's learned tensors by norm; `want` gives the tensor's of that number.
template <class Real, class Want>
void expect_gradients_near(const DeviceField& device, FieldBench<Real>& bench, double tolerance, const Want& want) {
  for (std::size_t i = 0; i < bench.box.count(); ++i) {
    if (!bench.box.learned(i)) continue;
    EXPECT_EQ(near_norm(*device.grads[i], want(i), tolerance), "") << bench.box.specs()[i].name;
  }
}
inline void expect_gradients_near(const DeviceField& device, FieldBench<double>& bench, double tolerance) {
  expect_gradients_near(device, bench, tolerance, [&](std::size_t i) { return bench.box.grad(i); });
}

}  // namespace semfield::testing
