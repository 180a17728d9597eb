// Device memory: what is copied there comes back, arenas and launches.
#include "cuda/memory.h"

#include "core/workspace.h"
#include "device_fixture.h"

namespace semfield {
namespace {

using testing::DeviceLaunch;
using testing::DeviceMatrix;

TEST(CudaMemory, MatricesComeBackAndTheirSurroundingsAreWatched) {
  SEMFIELD_NEEDS_DEVICE();
  const std::vector<float> values = testing::random_floats(33 * 3, 1, -1, 1);
  const DeviceMatrix<float> matrix(values, 3, 5);
  EXPECT_EQ(matrix.read(), values);
  EXPECT_EQ(matrix.surroundings(), "");
  cuda::check(cudaMemset(matrix.data() + 3, 0, sizeof(float)), "writing into a gap");
  EXPECT_NE(matrix.surroundings(), "");
}

TEST(CudaMemory, BuffersStartAsZerosAndArenasGiveAlignedDeviceMemory) {
  SEMFIELD_NEEDS_DEVICE();
  DeviceLaunch launch;
  const cuda::Buffer<float> buffer(1001, "a test");
  std::vector<float> back(1001, 7);
  cuda::download<float>(buffer.data(), back);
  cuda::synchronize();
  EXPECT_EQ(back, std::vector<float>(1001, 0));
  const Workspace::Scope scope(launch.arena());
  for (const std::int64_t rows : {0, 1, 33}) {
    const View<float> view = launch.arena().take<float>(rows, 3);
    EXPECT_EQ(view.device, Device::cuda);
    EXPECT_EQ(reinterpret_cast<std::uintptr_t>(view.data) % 256, 0u);
  }
}

TEST(CudaMemory, ABufferIsClearedBeforeOtherStreamsUseIt) {
  SEMFIELD_NEEDS_DEVICE();
  constexpr std::size_t kCount = 1001, kBusyBytes = std::size_t{1} << 28;
  const cuda::Buffer<std::byte> busy(kBusyBytes, "a test");
  cudaStream_t stream = nullptr;
  cuda::check(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking), "a stream of a test");
  const std::vector<float> values = testing::random_floats(kCount, 1, -1, 1);
  std::vector<float> back(kCount);
  {
    cuda::Launch own;
    own.stream = stream;
    const cuda::LaunchScope scope(own);
    for (int i = 0; i < 400; ++i) {  // the default stream has work for some 20 ms
      cuda::check(cudaMemsetAsync(busy.data(), i, kBusyBytes, nullptr), "work of a test");
    }
    const cuda::Buffer<float> buffer(kCount, "a test");
    cuda::upload<float>(values, buffer.data());
    cuda::check(cudaDeviceSynchronize(), "waiting for both streams");
    cuda::download<float>(buffer.data(), back);
    cuda::synchronize();
  }
  cuda::check(cudaStreamDestroy(stream), "a stream of a test");
  EXPECT_EQ(back, values);
}

TEST(CudaLaunch, AFaultIsTakenOutOfItsCellOnce) {
  SEMFIELD_NEEDS_DEVICE();
  DeviceLaunch launch(true);
  EXPECT_EQ(launch.take_fault(), std::nullopt);
  launch.set_fault((cuda::FaultKey{4} << cuda::kFaultRowBits) | 77);
  EXPECT_EQ(cuda::first_fault_row(cuda::Stage::density), -1);  // another stage's
  EXPECT_EQ(cuda::first_fault_row(static_cast<cuda::Stage>(4)), 77);
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

}  // namespace
}  // namespace semfield
