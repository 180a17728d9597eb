// The frequency encoder on the device against its float64 twin on the CPU.
#include "encoders/frequency/frequency.h"
#include "tests/cuda/encoder_bench.h"

namespace semfield {
namespace {

using namespace testing;

struct FrequencyCase {
  std::int32_t dims = 3;
  FrequencyParams params;
};

std::vector<FrequencyCase> frequency_cases() {
  std::vector<FrequencyCase> cases;
  for (const Arithmetic arithmetic : {Arithmetic::float64, Arithmetic::float32, Arithmetic::naive}) {
    for (const Angular angular : {Angular::radian, Angular::pi}) cases.push_back({3, {10, true, angular, arithmetic}});
  }
  cases.push_back({3, {4, true, Angular::radian, Arithmetic::float64}});
  cases.push_back({3, {10, false, Angular::radian, Arithmetic::float64}});
  cases.push_back({2, {7, true, Angular::radian, Arithmetic::float64}});
  cases.push_back({1, {0, true, Angular::radian, Arithmetic::float64}});
  cases.push_back({kFrequencyMaxDims, {40, true, Angular::pi, Arithmetic::float64}});
  cases.push_back({kFrequencyMaxDims, {40, false, Angular::radian, Arithmetic::float64}});
  return cases;
}

using CudaFrequency = testing::DeviceTest;

TEST_F(CudaFrequency, FollowsItsTwinOnTheCpu) {
  for (const FrequencyCase& c : frequency_cases()) {
    const EncoderTwins<Frequency> twins(frequency_kernels, c.params, c.dims);
    const std::string which = std::to_string(c.dims) + " coordinates, " + std::to_string(c.params.frequencies) +
                              " bands, arithmetic " + std::to_string(static_cast<int>(c.params.arithmetic));
    // Values: half a unit in the last place of 4 (the input) and of the polynomials. dx: its bands add up to 2^L with
    // errors of 1.2e-7 each.
    expect_twins_of_any_size(
        twins, which, [&](std::int64_t rows) { return random_doubles(rows * c.dims, 3, -4, 4); }, 2.4e-7, 1e-6,
        c.dims == 3 ? 4097 : 137);
  }
}

TEST_F(CudaFrequency, TheHighestBandIsAsAccurateAsTheLowestFarFromTheOrigin) {
  const FrequencyParams params{40, false, Angular::radian, Arithmetic::float64};
  expect_twins(EncoderTwins<Frequency>(frequency_kernels, params), random_doubles(3 * 1000, 5, -1048576, 1048576), {},
               1.3e-7, 1e-6);
}

TEST_F(CudaFrequency, CoordinatesThatCannotBeEncodedAreFaults) {
  const EncoderTwins<Frequency> twins(frequency_kernels, FrequencyParams{});
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL, 2147483648.0}) expect_fault_of(twins.device, bad);
}

}  // namespace
}  // namespace semfield
