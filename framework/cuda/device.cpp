#include "cuda/device.h"

#include <fmt/format.h>

#include "core/error.h"
#include "cuda/launch.h"

namespace semfield::cuda {

namespace {
constexpr int kOldestMajor = 8;  // bf16 matrix instructions
}

std::string describe_device(int ordinal) {
  int count = 0;
  check(cudaGetDeviceCount(&count), "looking for a device");
  if (count == 0) check(cudaErrorNoDevice, "looking for a device");
  if (ordinal >= count) {
    throw Error(ErrorKind::unavailable, "device.gpu.number",
                count == 1 ? "this machine has one CUDA device, cuda:0"
                           : fmt::format("this machine has {} CUDA devices, cuda:0 to cuda:{}", count, count - 1),
                "set runtime.device: cuda");
  }
  cudaDeviceProp found{};
  check(cudaGetDeviceProperties(&found, ordinal), "asking for the device's properties");
  if (found.major < kOldestMajor) {
    throw Error(ErrorKind::unavailable, "device.gpu.old",
                fmt::format("CUDA: {} has compute capability {}.{}, this build's kernels need 8.0", found.name,
                            found.major, found.minor),
                "set runtime.device: cpu");
  }
  return fmt::format("{}, {:.1f} GB, compute capability {}.{}", found.name,
                     static_cast<double>(found.totalGlobalMem) / 1e9, found.major, found.minor);
}

}  // namespace semfield::cuda
