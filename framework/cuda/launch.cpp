#include "cuda/launch.h"

#include <algorithm>
#include <string>

#include "core/error.h"

namespace semfield::cuda {

namespace {
thread_local Launch t_launch;
}

const Launch& launch() { return t_launch; }

void set_launch_rows(const std::int32_t* live_rows) { t_launch.live_rows = live_rows; }

LaunchScope::LaunchScope(const Launch& next) : before_(t_launch) {
  check(cudaGetDevice(&device_before_), "asking for the device");
  if (device_before_ != next.ordinal) check(cudaSetDevice(next.ordinal), "choosing the device");
  t_launch = next;
}
LaunchScope::~LaunchScope() {
  if (device_before_ != t_launch.ordinal) (void)cudaSetDevice(device_before_);
  t_launch = before_;
}

void check(cudaError_t status, const char* what) {
  if (status == cudaSuccess) return;
  if (status == cudaErrorMemoryAllocation)
    throw Error(ErrorKind::unavailable, "memory.device.full", std::string("CUDA: no device memory for ") + what,
                "close other programs that use the device, or set runtime.device: cpu");
  const bool no_device = status == cudaErrorNoDevice || status == cudaErrorInsufficientDriver;
  throw Error(no_device ? ErrorKind::unavailable : ErrorKind::failure, "device.cuda.failed",
              std::string("CUDA: ") + what + ": " + cudaGetErrorString(status) + " (" + cudaGetErrorName(status) + ")",
              no_device ? "set runtime.device: cpu, or install the driver of the GPU" : "");
}

std::int64_t first_fault_row(Stage stage) {
  if (!t_launch.check_at_once || t_launch.fault == nullptr) return -1;
  FaultKey key = kNoFault;
  check(cudaMemcpyAsync(&key, t_launch.fault, sizeof key, cudaMemcpyDeviceToHost, t_launch.stream), "reading a fault");
  check(cudaStreamSynchronize(t_launch.stream), "waiting for a kernel");
  if (key == kNoFault || static_cast<Stage>(key >> kFaultRowBits) != stage) return -1;
  check(cudaMemsetAsync(t_launch.fault, 0xFF, sizeof key, t_launch.stream), "resetting a fault");
  return static_cast<std::int64_t>(key & ((FaultKey{1} << kFaultRowBits) - 1));
}

int multiprocessors() {
  int value = 0;
  check(cudaDeviceGetAttribute(&value, cudaDevAttrMultiProcessorCount, t_launch.ordinal), "asking for multiprocessors");
  return std::max(1, value / t_launch.beside);
}

}  // namespace semfield::cuda
