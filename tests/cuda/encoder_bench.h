// An encoder on the device against its float64 twin on the CPU, and what it does with a coordinate that cannot be
// encoded.
#pragma once

#include "core/error.h"
#include "cuda/kernels/kernels.h"
#include "plugin/encoder.h"
#include "testkit/compare.h"
#include "tests/cuda/device_fixture.h"

namespace semfield::testing {

/// The encoder with the kernels of both devices.
template <class Encoder, class Params>
Encoder make_encoder(void (*kernels)(KernelTables&), const Params& params, std::int32_t dims, Device device) {
  static const KernelTables tables = tables_of({kernels, cuda::add_plugin_kernels});
  EncoderBuild build{.device = device, .in_dims = dims};
  return Encoder(params, build, tables);
}

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

/// y and dx of both twins; errors relative to the largest value, of dx to the largest slope of any output.
template <class Real32, class Real64>
void expect_twins(const Real32& device, const Real64& host, const std::vector<double>& x, Strides strides,
                  double tolerance, double dx_tolerance) {
  const EncoderTraits traits = host.traits();
  const auto rows = static_cast<std::int64_t>(x.size()) / traits.in_dims;
  const std::vector<float> dy = random_floats(rows * traits.out_dims, 7, -1, 1);
  std::vector<double> y64(dy.size()), dx64(x.size()), dy64 = widen(dy);
  const View<const double> x_host = host_view(x, traits.in_dims);
  host.forward({}, {}, x_host, host_view(y64, traits.out_dims));
  host.backward({}, {}, x_host, host_view(std::as_const(dy64), traits.out_dims), host_view(dx64, traits.in_dims));

  DeviceLaunch launch(true);
  StepContext ctx{.workspace = &launch.arena()};
  const DeviceMatrix<double> x_device(x, traits.in_dims, traits.in_dims + strides.x);
  const DeviceMatrix<float> dy_device(dy, traits.out_dims, traits.out_dims + strides.y);
  const DeviceMatrix<float> y(rows, traits.out_dims, traits.out_dims + strides.y);
  const DeviceMatrix<float> dx(rows, traits.in_dims, traits.in_dims + strides.x);
  device.forward(ctx, {}, x_device.read_only(), y.view());
  device.backward(ctx, {}, x_device.read_only(), dy_device.read_only(), dx.view());
  const std::vector<float> y32 = y.read(), dx32 = dx.read();
  EXPECT_EQ(
      testkit::compare(host_view(y32, traits.out_dims), host_view(std::as_const(y64), traits.out_dims), tolerance, 1),
      "");
  EXPECT_EQ(
      testkit::compare(host_view(dx32, traits.in_dims), host_view(std::as_const(dx64), traits.in_dims), dx_tolerance),
      "");
  EXPECT_EQ(y.surroundings(), "");
  EXPECT_EQ(dx.surroundings(), "");
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

// A coordinate that cannot be encoded is noted with its first row, or thrown where faults are reported at once; every
// value is finite all the same.
inline void expect_fault_of(const Encoder<float>& encoder, double bad) {
  std::vector<double> x = random_doubles(3 * 200, 1, -1, 1);
  x[3 * 150 + 1] = bad;
  x[3 * 77 + 2] = bad;
  const DeviceMatrix<double> x_device(x, 3);
  const DeviceMatrix<float> y(200, encoder.traits().out_dims);
  {
    DeviceLaunch launch;
    encoder.forward({}, {}, x_device.read_only(), y.view());
    EXPECT_EQ(launch.take_fault(), (NotedFault{cuda::Stage::encoded_position, 77}));
    for (const float v : y.read()) ASSERT_TRUE(std::isfinite(v));
  }
  DeviceLaunch at_once(true);
  EXPECT_THROW(encoder.forward({}, {}, x_device.read_only(), y.view()), Error);
  EXPECT_EQ(at_once.take_fault(), std::nullopt);
}

}  // namespace semfield::testing
