#include "cuda/calls.h"

#include <fmt/format.h>

#include "core/error.h"
#include "cuda/launch.h"
#include "cuda/memory.h"

namespace semfield::cuda {

namespace {

std::byte* take(std::size_t bytes) { return allocate(bytes, "memory of a single call"); }
void give_back(std::byte* block) { release(block); }

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

DeviceCalls device_calls() { return {{Device::cuda, take, give_back}, to_device, to_host, run, on}; }

}  // namespace semfield::cuda
