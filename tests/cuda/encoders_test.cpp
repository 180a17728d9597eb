// Frequency, one-blob and spherical harmonics encoders on the device against their float64 twins on the CPU.
#include <cmath>

#include "core/error.h"
#include "cuda/kernel_tables.h"
#include "device_fixture.h"
#include "plugins/encoders/frequency/frequency.h"
#include "plugins/encoders/one_blob/one_blob.h"
#include "plugins/encoders/spherical_harmonics/spherical_harmonics.h"
#include "testkit/compare.h"

namespace semfield {
namespace {

using cuda::Stage;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::NotedFault;

const KernelTables& all_kernels() {
  static const KernelTables tables =
      testing::tables_of({frequency_kernels, one_blob_kernels, spherical_harmonics_kernels, cuda::add_plugin_kernels});
  return tables;
}

template <class Encoder, class Params>
Encoder make(const Params& params, std::int32_t dims, Device device) {
  EncoderBuild build;
  build.device = device;
  build.in_dims = dims;
  return Encoder(params, build, all_kernels());
}

/// Coordinates with all bits of a double in use.
std::vector<double> random_doubles(std::int64_t count, std::uint64_t seed, double low, double high) {
  std::vector<double> values = testing::widen(testing::random_floats(count, seed, low, high));
  const std::vector<float> rest = testing::random_floats(count, seed + 100, -1e-8, 1e-8);
  for (std::size_t i = 0; i < values.size(); ++i) values[i] += static_cast<double>(rest[i]);
  return values;
}

std::vector<double> random_directions(std::int64_t rows, std::uint64_t seed) {
  std::vector<double> x = random_doubles(3 * rows, seed, -1, 1);
  for (std::size_t r = 0; r < x.size(); r += 3) {
    const double norm = std::sqrt(x[r] * x[r] + x[r + 1] * x[r + 1] + x[r + 2] * x[r + 2]);
    for (std::size_t d = r; d < r + 3; ++d) x[d] /= norm;
  }
  return x;
}

struct Strides {
  std::int32_t x = 0, y = 0;  // beyond the columns
};
constexpr Strides kStrides[] = {{0, 0}, {1, 1}, {2, 5}};

/// y and dx of both twins; errors relative to the largest value, of dx to the largest slope of any output.
template <class Real32, class Real64>
void expect_twins(const Real32& device, const Real64& host, const std::vector<double>& x, Strides strides,
                  double tolerance, double dx_tolerance) {
  const EncoderTraits traits = host.traits();
  const auto rows = static_cast<std::int64_t>(x.size()) / traits.in_dims;
  const std::vector<float> dy = testing::random_floats(rows * traits.out_dims, 7, -1, 1);
  std::vector<double> y64(dy.size()), dx64(x.size()), dy64 = testing::widen(dy);
  const View<const double> x_host = testing::host_view(x, traits.in_dims);
  host.forward({}, {}, x_host, testing::host_view(y64, traits.out_dims));
  host.backward({}, {}, x_host, testing::host_view(std::as_const(dy64), traits.out_dims),
                testing::host_view(dx64, traits.in_dims));

  DeviceLaunch launch(true);
  StepContext ctx;
  ctx.workspace = &launch.arena();
  const DeviceMatrix<double> x_device(x, traits.in_dims, traits.in_dims + strides.x);
  const DeviceMatrix<float> dy_device(dy, traits.out_dims, traits.out_dims + strides.y);
  const DeviceMatrix<float> y(rows, traits.out_dims, traits.out_dims + strides.y);
  const DeviceMatrix<float> dx(rows, traits.in_dims, traits.in_dims + strides.x);
  device.forward(ctx, {}, x_device.read_only(), y.view());
  device.backward(ctx, {}, x_device.read_only(), dy_device.read_only(), dx.view());
  const std::vector<float> y32 = y.read(), dx32 = dx.read();
  EXPECT_EQ(testkit::compare(testing::host_view(y32, traits.out_dims),
                             testing::host_view(std::as_const(y64), traits.out_dims), tolerance, 1),
            "");
  EXPECT_EQ(testkit::compare(testing::host_view(dx32, traits.in_dims),
                             testing::host_view(std::as_const(dx64), traits.in_dims), dx_tolerance),
            "");
  EXPECT_EQ(y.surroundings(), "");
  EXPECT_EQ(dx.surroundings(), "");
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

// A coordinate that cannot be encoded is noted with its first row, or thrown where faults are told at once; every value
// is finite all the same.
void expect_fault_of(const Encoder<float>& encoder, double bad) {
  std::vector<double> x = random_doubles(3 * 200, 1, -1, 1);
  x[3 * 150 + 1] = bad;
  x[3 * 77 + 2] = bad;
  const DeviceMatrix<double> x_device(x, 3);
  const DeviceMatrix<float> y(200, encoder.traits().out_dims);
  {
    DeviceLaunch launch;
    encoder.forward({}, {}, x_device.read_only(), y.view());
    EXPECT_EQ(launch.take_fault(), (NotedFault{Stage::encoded_position, 77}));
    for (const float v : y.read()) ASSERT_TRUE(std::isfinite(v));
  }
  DeviceLaunch at_once(true);
  EXPECT_THROW(encoder.forward({}, {}, x_device.read_only(), y.view()), Error);
  EXPECT_EQ(at_once.take_fault(), std::nullopt);
}

struct FrequencyCase {
  std::int32_t dims = 3;
  FrequencyParams params;
};

std::vector<FrequencyCase> frequency_cases() {
  std::vector<FrequencyCase> cases;
  for (const Arithmetic arithmetic : {Arithmetic::float64, Arithmetic::float32, Arithmetic::naive}) {
    for (const Angular angular : {Angular::radian, Angular::pi}) {
      cases.push_back({3, {10, true, angular, arithmetic}});
    }
  }
  cases.push_back({3, {4, true, Angular::radian, Arithmetic::float64}});
  cases.push_back({3, {10, false, Angular::radian, Arithmetic::float64}});
  cases.push_back({2, {7, true, Angular::radian, Arithmetic::float64}});
  cases.push_back({1, {0, true, Angular::radian, Arithmetic::float64}});
  cases.push_back({kFrequencyMaxDims, {40, true, Angular::pi, Arithmetic::float64}});
  cases.push_back({kFrequencyMaxDims, {40, false, Angular::radian, Arithmetic::float64}});
  return cases;
}

TEST(CudaFrequency, FollowsItsTwinOnTheCpu) {
  SEMFIELD_NEEDS_DEVICE();
  for (const FrequencyCase& c : frequency_cases()) {
    const auto device = make<Frequency<float>>(c.params, c.dims, Device::cuda);
    const auto host = make<Frequency<double>>(c.params, c.dims, Device::cpu);
    for (const std::int64_t rows : {0, 1, 31, 33, 64, c.dims == 3 ? 4097 : 137}) {
      for (const Strides strides : kStrides) {
        SCOPED_TRACE(std::to_string(c.dims) + " coordinates, " + std::to_string(c.params.frequencies) + " bands, " +
                     std::to_string(rows) + " rows, stride +" + std::to_string(strides.y) + ", arithmetic " +
                     std::to_string(static_cast<int>(c.params.arithmetic)));
        // Values: half a unit in the last place of 4 (the input) and of the polynomials. dx: its bands add up to 2^L
        // with errors of 1.2e-7 each.
        expect_twins(device, host, random_doubles(rows * c.dims, 3, -4, 4), strides, 2.4e-7, 1e-6);
      }
    }
  }
}

TEST(CudaFrequency, TheHighestBandIsAsAccurateAsTheLowestFarFromTheOrigin) {
  SEMFIELD_NEEDS_DEVICE();
  const FrequencyParams params{40, false, Angular::radian, Arithmetic::float64};
  expect_twins(make<Frequency<float>>(params, 3, Device::cuda), make<Frequency<double>>(params, 3, Device::cpu),
               random_doubles(3 * 1000, 5, -1048576, 1048576), {}, 1.3e-7, 1e-6);
}

TEST(CudaFrequency, CoordinatesThatCannotBeEncodedAreFaults) {
  SEMFIELD_NEEDS_DEVICE();
  const auto encoder = make<Frequency<float>>(FrequencyParams{}, 3, Device::cuda);
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL, 2147483648.0}) expect_fault_of(encoder, bad);
}

TEST(CudaOneBlob, FollowsItsTwinOnTheCpu) {
  SEMFIELD_NEEDS_DEVICE();
  for (const int bins : {2, 7, 16, 17, 64}) {
    const auto device = make<OneBlob<float>>(OneBlobParams{bins}, 3, Device::cuda);
    const auto host = make<OneBlob<double>>(OneBlobParams{bins}, 3, Device::cpu);
    for (const std::int64_t rows : {0, 1, 31, 33, 4097}) {
      for (const Strides strides : kStrides) {
        SCOPED_TRACE(std::to_string(bins) + " bins, " + std::to_string(rows) + " rows, stride +" +
                     std::to_string(strides.y));
        // Values: two units in the last place of 1. dx: sums of slopes with such errors. Some rows are clamped.
        expect_twins(device, host, random_doubles(3 * rows, 3, -0.2, 1.2), strides, 1.2e-7, 1e-6);
      }
    }
  }
}

TEST(CudaOneBlob, CoordinatesThatAreNotFiniteAreFaults) {
  SEMFIELD_NEEDS_DEVICE();
  const auto encoder = make<OneBlob<float>>(OneBlobParams{}, 3, Device::cuda);
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL}) expect_fault_of(encoder, bad);
}

TEST(CudaSphericalHarmonics, FollowTheirTwinOnTheCpu) {
  SEMFIELD_NEEDS_DEVICE();
  for (int degree = 1; degree <= kHarmonicMaxDegree; ++degree) {
    const auto device = make<SphericalHarmonics<float>>(SphericalHarmonicsParams{degree}, 3, Device::cuda);
    const auto host = make<SphericalHarmonics<double>>(SphericalHarmonicsParams{degree}, 3, Device::cpu);
    for (const std::int64_t rows : {0, 1, 31, 33, 4097}) {
      for (const Strides strides : kStrides) {
        SCOPED_TRACE("degree " + std::to_string(degree) + ", " + std::to_string(rows) + " rows, stride +" +
                     std::to_string(strides.y));
        // Polynomials of degree 4 with coefficients up to 105: a few units in the last place of their largest terms.
        expect_twins(device, host, random_directions(rows, 2), strides, 2e-6, 2e-6);
      }
    }
  }
}

TEST(CudaSphericalHarmonics, RowsThatAreNoUnitVectorsAreFaults) {
  SEMFIELD_NEEDS_DEVICE();
  const auto encoder = make<SphericalHarmonics<float>>(SphericalHarmonicsParams{}, 3, Device::cuda);
  for (const double bad : {std::nan(""), HUGE_VAL, 0.0, 1.1}) {
    std::vector<double> x = random_directions(300, 1);
    for (const std::size_t row : {299, 128}) x[3 * row] = bad, x[3 * row + 1] = x[3 * row + 2] = 0;
    const DeviceMatrix<double> x_device(x, 3);
    const DeviceMatrix<float> y(300, encoder.traits().out_dims);
    {
      DeviceLaunch launch;
      encoder.forward({}, {}, x_device.read_only(), y.view());
      EXPECT_EQ(launch.take_fault(), (NotedFault{Stage::encoded_position, 128}));
      for (const float v : y.read()) ASSERT_TRUE(std::isfinite(v));
    }
    DeviceLaunch at_once(true);
    EXPECT_THROW(encoder.forward({}, {}, x_device.read_only(), y.view()), Error);
  }
}

}  // namespace
}  // namespace semfield
