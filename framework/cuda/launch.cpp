#include "cuda/launch.h"

#include <fmt/format.h>

#include <algorithm>

#include "core/error.h"

namespace semfield::cuda {

namespace {

thread_local Launch t_launch;
constexpr int kOldestMajor = 8;  // bf16 matrix instructions

std::byte* take(std::size_t bytes) { return allocate(bytes, "memory of a single call"); }

void to_device(const void* from, std::byte* to, std::size_t bytes) {
  check(cudaMemcpy(to, from, bytes, cudaMemcpyHostToDevice), "copying to the device");
}
void to_host(const std::byte* from, void* to, std::size_t bytes) {
  check(cudaMemcpy(to, from, bytes, cudaMemcpyDeviceToHost), "copying from the device");
}

void run(bool deterministic, const std::function<void()>& body) {
  const Buffer<FaultKey> fault(1, "fault of a single call");
  check(cudaMemset(fault.data(), 0xFF, sizeof(FaultKey)), "resetting a fault");
  Launch here;
  here.fault = fault.data();
  here.check_at_once = true;
  here.deterministic = deterministic;
  {
    const LaunchScope scope(here);
    body();
    synchronize();
  }
  FaultKey left = kNoFault;
  to_host(reinterpret_cast<const std::byte*>(fault.data()), &left, sizeof left);
  if (left == kNoFault) return;
  throw Error(ErrorKind::failure, "internal.cuda.fault",
              fmt::format("CUDA: a fault of stage {} in row {} was not asked for", left >> kFaultRowBits,
                          left & ((FaultKey{1} << kFaultRowBits) - 1)));
}

void on(int ordinal, const std::function<void()>& body) {
  Launch here;
  here.ordinal = ordinal;
  const LaunchScope scope(here);
  body();
}

}  // namespace

DeviceCalls device_calls() { return {{Device::cuda, take, release}, to_device, to_host, run, on}; }

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
  return value;
}

std::byte* allocate(std::size_t bytes, const char* what) {
  void* memory = nullptr;
  const cudaError_t status = cudaMalloc(&memory, bytes);
  if (status == cudaErrorMemoryAllocation) {
    (void)cudaGetLastError();  // this error is answered here and must not come back at the next launch
    std::size_t unused = 0, total = 0;
    (void)cudaMemGetInfo(&unused, &total);
    throw Error(ErrorKind::unavailable, "memory.device.full",
                fmt::format("CUDA: no device memory for '{}': requested {:.1f} MB, free {:.1f} MB of {:.1f} MB", what,
                            1e-6 * static_cast<double>(bytes), 1e-6 * static_cast<double>(unused),
                            1e-6 * static_cast<double>(total)),
                "lower train.rays, take fewer samples per ray, or set runtime.precision: bf16");
  }
  check(status, what);
  return static_cast<std::byte*>(memory);
}

void release(std::byte* memory) noexcept {
  if (memory != nullptr) (void)cudaFree(memory);
}

BlockSource arena_source() {
  return {Device::cuda, [](std::size_t bytes) { return allocate(bytes, "activations of a step"); }, release};
}

std::byte* zeroed(std::size_t bytes, const char* what) {
  if (bytes == 0) return nullptr;
  std::byte* const memory = allocate(bytes, what);
  // Queued on the default stream, for which the streams of pipelines do not wait.
  check(cudaMemset(memory, 0, bytes), what);
  check(cudaStreamSynchronize(nullptr), what);
  return memory;
}

std::size_t free_bytes() {
  std::size_t unused = 0, total = 0;
  check(cudaMemGetInfo(&unused, &total), "asking for free memory");
  return unused;
}
void synchronize() { check(cudaStreamSynchronize(launch().stream), "waiting for the device"); }

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
