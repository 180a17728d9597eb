// The one-blob encoder on the device against its float64 twin on the CPU.
#include "tests/cuda/encoder_bench.h"

namespace semfield {
namespace {

using namespace testing;

using CudaOneBlob = testing::DeviceTest;

TEST_F(CudaOneBlob, FollowsItsTwinOnTheCpu) {
  for (const int bins : {2, 7, 16, 17, 64}) {
    const EncoderTwins twins("one_blob", {{"bins", std::to_string(bins)}});
    // Values: two units in the last place of 1. dx: sums of slopes with such errors. Some rows are clamped.
    expect_twins_of_any_size(
        twins, std::to_string(bins) + " bins", [](std::int64_t rows) { return random_doubles(3 * rows, 3, -0.2, 1.2); },
        1.2e-7, 1e-6);
  }
}

TEST_F(CudaOneBlob, CoordinatesThatAreNotFiniteAreFaults) {
  const EncoderTwins twins("one_blob", {});
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL}) expect_fault_of(*twins.device, bad);
}

}  // namespace
}  // namespace semfield
