// An encoder on the device against its float64 twin on the CPU, and what it does with a coordinate that cannot be
// encoded.
#pragma once

#include "core/error.h"
#include "cuda/kernels/kernels.h"
#include "plugin/encoder.h"
#include "tests/cuda/device_fixture.h"
#include "tests/encoder_box.h"

namespace semfield::testing {

/// An encoder on the device and its float64 twin on the CPU.
struct EncoderTwins {
  EncoderTwins(const std::string& name, const testkit::Settings& settings, std::int32_t dims = 3)
      : device(testkit::make_part<float>(registry_with_cuda(), name, settings,
                                         EncoderBuild{.device = Device::cuda, .in_dims = dims})),
        host(testkit::make_part<double>(registry_with_cuda(), name, settings, EncoderBuild{.in_dims = dims})) {}
  std::unique_ptr<Encoder<float>> device;
  std::unique_ptr<Encoder<double>> host;
};

/// Coordinates with all bits of a double in use.
inline std::vector<double> random_doubles(std::int64_t count, std::uint64_t seed, double low, double high) {
  std::vector<double> values = widen(random_floats(count, seed, low, high));
  const std::vector<float> rest = random_floats(count, seed + 100, -1e-8, 1e-8);
  for (std::size_t i = 0; i < values.size(); ++i) values[i] += static_cast<double>(rest[i]);
  return values;
}

struct Strides {
  std::int32_t x = 0, y = 0;  // beyond the columns
};
inline constexpr Strides kStrides[] = {{0, 0}, {1, 1}, {2, 5}};

/// y, dx and the gradients of tensors of both twins, as fast as it can and in deterministic mode; errors relative to
/// the largest value, of dx to the largest slope of any output.
inline void expect_twins(const Encoder<float>& device, const Encoder<double>& host, const std::vector<double>& x,
                         const std::vector<float>& dy, Strides strides, double tolerance, double dx_tolerance) {
  const EncoderTraits traits = host.traits();
  const auto rows = static_cast<std::int64_t>(x.size()) / traits.in_dims;
  const testkit::TensorBox<double> oracle(host, 3, 1);
  std::vector<double> y64(dy.size()), dx64(x.size()), dy64 = widen(dy);
  const View<const double> x_host = host_view(x, traits.in_dims);
  Workspace workspace;
  StepContext host_ctx{.workspace = &workspace};
  host.forward(host_ctx, oracle.tensors(), x_host, host_view(y64, traits.out_dims));
  host.backward(host_ctx, oracle.tensors(), x_host, host_view(std::as_const(dy64), traits.out_dims),
                host_view(dx64, traits.in_dims));

  DeviceLaunch launch(true);
  StepContext ctx{.workspace = &launch.arena()};
  const DeviceTensors there(testkit::TensorBox<float>(device, 3, 1));
  const DeviceMatrix<double> x_device(x, traits.in_dims, traits.in_dims + strides.x);
  const DeviceMatrix<float> dy_device(dy, traits.out_dims, traits.out_dims + strides.y);
  const DeviceMatrix<float> y(rows, traits.out_dims, traits.out_dims + strides.y);
  const DeviceMatrix<float> dx(rows, traits.in_dims, traits.in_dims + strides.x);
  device.forward(ctx, there.tensors(), x_device.read_only(), y.view());
  EXPECT_EQ(near(y, y64, tolerance, 1), "");
  for (const bool deterministic : {false, true}) {
    SCOPED_TRACE(deterministic ? "deterministic" : "in any order");
    launch.set_deterministic(deterministic);
    there.clear_gradients();
    device.backward(ctx, there.tensors(), x_device.read_only(), dy_device.read_only(), dx.view());
    for (std::size_t i = 0; i < there.grads.size(); ++i)
      EXPECT_EQ(near(*there.grads[i], oracle.grad(i), dx_tolerance), "") << "tensor " << i;
    EXPECT_EQ(near(dx, dx64, dx_tolerance), "");
  }
  EXPECT_EQ(y.surroundings() + dx.surroundings() + there.surroundings(), "");
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}
inline void expect_twins(const EncoderTwins& twins, const std::vector<double>& x, Strides strides, double tolerance,
                         double dx_tolerance) {
  const EncoderTraits traits = twins.host->traits();
  const std::int64_t rows = static_cast<std::int64_t>(x.size()) / traits.in_dims;
  expect_twins(*twins.device, *twins.host, x, random_floats(rows * traits.out_dims, 7, -1, 1), strides, tolerance,
               dx_tolerance);
}

/// The same for batches of many sizes, the largest of `most` rows, and of every stride; `x_of` gives their coordinates.
template <class Coordinates>
void expect_twins_of_any_size(const EncoderTwins& twins, const std::string& which, Coordinates&& x_of, double tolerance,
                              double dx_tolerance, std::int64_t most = 4097) {
  for (const std::int64_t rows :
       {std::int64_t{0}, std::int64_t{1}, std::int64_t{31}, std::int64_t{33}, std::int64_t{64}, most}) {
    for (const Strides strides : kStrides) {
      SCOPED_TRACE(which + ", " + std::to_string(rows) + " rows, stride +" + std::to_string(strides.y));
      expect_twins(twins, x_of(rows), strides, tolerance, dx_tolerance);
    }
  }
}

/// Coordinates that cannot be encoded are noted with their first row, or thrown where faults are reported at once;
/// every value is finite all the same.
inline void expect_fault_of(const Encoder<float>& encoder, const std::vector<double>& x, std::int64_t row) {
  const DeviceMatrix<double> x_device(x, 3);
  const DeviceMatrix<float> y(static_cast<std::int64_t>(x.size()) / 3, encoder.traits().out_dims);
  {
    DeviceLaunch launch;
    encoder.forward({}, {}, x_device.read_only(), y.view());
    EXPECT_EQ(launch.take_fault(), (NotedFault{cuda::Stage::encoded_position, row}));
    for (const float v : y.read()) ASSERT_TRUE(std::isfinite(v));
  }
  DeviceLaunch at_once(true);
  EXPECT_THROW(encoder.forward({}, {}, x_device.read_only(), y.view()), Error);
  EXPECT_EQ(at_once.take_fault(), std::nullopt);
}
inline void expect_fault_of(const Encoder<float>& encoder, double bad) {
  std::vector<double> x = random_doubles(3 * 200, 1, -1, 1);
  x[3 * 150 + 1] = bad;
  x[3 * 77 + 2] = bad;
  expect_fault_of(encoder, x, 77);
}

}  // namespace semfield::testing
