// The spherical harmonics on the device against their float64 twin on the CPU.
#include "encoders/spherical_harmonics/spherical_harmonics_kernels.h"
#include "tests/cuda/encoder_bench.h"

namespace semfield {
namespace {

using namespace testing;

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
    const EncoderTwins twins("spherical_harmonics", {{"degree", std::to_string(degree)}});
    // Polynomials of degree 4 with coefficients up to 105: a few units in the last place of their largest terms.
    expect_twins_of_any_size(
        twins, "degree " + std::to_string(degree), [](std::int64_t rows) { return random_directions(rows, 2); }, 2e-6,
        2e-6);
  }
}

TEST_F(CudaSphericalHarmonics, RowsThatAreNoUnitVectorsAreFaults) {
  const EncoderTwins twins("spherical_harmonics", {});
  for (const double bad : {std::nan(""), HUGE_VAL, 0.0, 1.1}) {
    std::vector<double> x = random_directions(300, 1);
    for (const std::size_t row : {299, 128}) x[3 * row] = bad, x[3 * row + 1] = x[3 * row + 2] = 0;
    expect_fault_of(*twins.device, x, 128);
  }
}

}  // namespace
}  // namespace semfield
