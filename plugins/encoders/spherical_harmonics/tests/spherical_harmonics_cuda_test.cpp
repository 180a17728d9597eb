// The spherical harmonics on the device against their float64 twin on the CPU.
#include "encoders/spherical_harmonics/spherical_harmonics.h"
#include "tests/cuda/encoder_bench.h"

namespace semfield {
namespace {

using namespace testing;

template <class Encoder, class Params>
Encoder make(const Params& params, std::int32_t dims, Device device) {
  return make_encoder<Encoder>(spherical_harmonics_kernels, params, dims, device);
}

std::vector<double> random_directions(std::int64_t rows, std::uint64_t seed) {
  std::vector<double> x = random_doubles(3 * rows, seed, -1, 1);
  for (std::size_t r = 0; r < x.size(); r += 3) {
    const double norm = std::sqrt(x[r] * x[r] + x[r + 1] * x[r + 1] + x[r + 2] * x[r + 2]);
    for (std::size_t d = r; d < r + 3; ++d) x[d] /= norm;
  }
  return x;
}

using CudaSphericalHarmonics = testing::DeviceTest;

TEST_F(CudaSphericalHarmonics, FollowTheirTwinOnTheCpu) {
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

TEST_F(CudaSphericalHarmonics, RowsThatAreNoUnitVectorsAreFaults) {
  const auto encoder = make<SphericalHarmonics<float>>(SphericalHarmonicsParams{}, 3, Device::cuda);
  for (const double bad : {std::nan(""), HUGE_VAL, 0.0, 1.1}) {
    std::vector<double> x = random_directions(300, 1);
    for (const std::size_t row : {299, 128}) x[3 * row] = bad, x[3 * row + 1] = x[3 * row + 2] = 0;
    const DeviceMatrix<double> x_device(x, 3);
    const DeviceMatrix<float> y(300, encoder.traits().out_dims);
    {
      DeviceLaunch launch;
      encoder.forward({}, {}, x_device.read_only(), y.view());
      EXPECT_EQ(launch.take_fault(), (NotedFault{cuda::Stage::encoded_position, 128}));
      for (const float v : y.read()) ASSERT_TRUE(std::isfinite(v));
    }
    DeviceLaunch at_once(true);
    EXPECT_THROW(encoder.forward({}, {}, x_device.read_only(), y.view()), Error);
  }
}

}  // namespace
}  // namespace semfield
