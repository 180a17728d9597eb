// The frequency encoder on the device against its float64 twin on the CPU.
#include "encoders/frequency/frequency_kernels.h"
#include "tests/cuda/encoder_bench.h"

namespace semfield {
namespace {

using namespace testing;

struct FrequencyCase {
  std::int32_t dims, bands;
  bool input = true;
  const char *angular = "radian", *arithmetic = "float64";

  EncoderTwins twins() const {
    return {"frequency",
            {{"frequencies", std::to_string(bands)},
             {"include_input", input ? "true" : "false"},
             {"angular", angular},
             {"arithmetic", arithmetic}},
            dims};
  }
};

std::vector<FrequencyCase> frequency_cases() {
  std::vector<FrequencyCase> cases;
  for (const char* arithmetic : {"float64", "float32", "naive"}) {
    for (const char* angular : {"radian", "pi"}) cases.push_back({3, 10, true, angular, arithmetic});
  }
  cases.push_back({3, 4});
  cases.push_back({3, 10, false});
  cases.push_back({2, 7});
  cases.push_back({1, 0});
  cases.push_back({kFrequencyMaxDims, 40, true, "pi"});
  cases.push_back({kFrequencyMaxDims, 40, false});
  return cases;
}

using CudaFrequency = testing::DeviceTest;

TEST_F(CudaFrequency, FollowsItsTwinOnTheCpu) {
  for (const FrequencyCase& c : frequency_cases()) {
    const EncoderTwins twins = c.twins();
    const std::string which =
        std::to_string(c.dims) + " coordinates, " + std::to_string(c.bands) + " bands, arithmetic " + c.arithmetic;
    // Values: half a unit in the last place of 4 (the input) and of the polynomials. dx: its bands add up to 2^L with
    // errors of 1.2e-7 each.
    expect_twins_of_any_size(
        twins, which, [&](std::int64_t rows) { return random_doubles(rows * c.dims, 3, -4, 4); }, 2.4e-7, 1e-6,
        c.dims == 3 ? 4097 : 137);
  }
}

TEST_F(CudaFrequency, TheHighestBandIsAsAccurateAsTheLowestFarFromTheOrigin) {
  expect_twins(FrequencyCase{3, 40, false}.twins(), random_doubles(3 * 1000, 5, -1048576, 1048576), {}, 1.3e-7, 1e-6);
}

TEST_F(CudaFrequency, CoordinatesThatCannotBeEncodedAreFaults) {
  const EncoderTwins twins("frequency", {});
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL, 2147483648.0}) expect_fault_of(*twins.device, bad);
}

}  // namespace
}  // namespace semfield
