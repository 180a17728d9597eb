#include "execution/device_library.h"

#include <dlfcn.h>

#include "core/error.h"
#include "core/process.h"

namespace semfield {

bool has_cuda_library() noexcept {
#ifdef SEMFIELD_CUDA_LIBRARY
  return true;
#else
  return false;
#endif
}

const DeviceLibrary& cuda_library() {
#ifdef SEMFIELD_CUDA_LIBRARY
  static const DeviceLibrary* const loaded = reinterpret_cast<const DeviceLibrary* (*)()>(
      library_symbol(SEMFIELD_CUDA_LIBRARY, kDeviceLibrarySymbol, "the CUDA kernels cannot be loaded",
                     "install the CUDA runtime and cuBLASLt, or set runtime.device: cpu"))();
  return *loaded;
#else
  throw Error(ErrorKind::unavailable, "device.cuda.missing",
              "runtime.device: this build has no CUDA kernels (has: cpu)",
              "set runtime.device: cpu, or build where a CUDA compiler is found");
#endif
}

bool cuda_available(std::string* why_not, [[maybe_unused]] int ordinal) {
#ifndef SEMFIELD_CUDA_LIBRARY
  if (why_not != nullptr) *why_not = "this build has no CUDA kernels (has: cpu)";
  return false;
#else
  // Asked before our library, which brings half a gigabyte of products along.
  static const bool has_driver = ::dlopen("libcuda.so.1", RTLD_LAZY | RTLD_LOCAL) != nullptr;
  if (!has_driver) {
    if (why_not != nullptr) *why_not = "this machine has no NVIDIA driver";
    return false;
  }
  try {
    (void)cuda_library().describe(ordinal);
    return true;
  } catch (const Error& error) {
    if (why_not != nullptr) *why_not = error.message();
    return false;
  }
#endif
}

}  // namespace semfield
