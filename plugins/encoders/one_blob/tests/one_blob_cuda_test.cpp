// The one-blob encoder on the device against its float64 twin on the CPU.
#include "encoders/one_blob/one_blob.h"
#include "tests/cuda/encoder_bench.h"

namespace semfield {
namespace {

using namespace testing;

template <class Encoder, class Params>
Encoder make(const Params& params, std::int32_t dims, Device device) {
  return make_encoder<Encoder>(one_blob_kernels, params, dims, device);
}

using CudaOneBlob = testing::DeviceTest;

TEST_F(CudaOneBlob, FollowsItsTwinOnTheCpu) {
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

TEST_F(CudaOneBlob, CoordinatesThatAreNotFiniteAreFaults) {
  const auto encoder = make<OneBlob<float>>(OneBlobParams{}, 3, Device::cuda);
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL}) expect_fault_of(encoder, bad);
}

}  // namespace
}  // namespace semfield
