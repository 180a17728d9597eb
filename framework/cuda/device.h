// Which GPU a run uses.
#pragma once

#include <string>

namespace semfield::cuda {

/// "NVIDIA H200, 143.8 GB, compute capability 9.0". Throws Error(unavailable) without that device, or for one too old
/// for this build's kernels.
std::string describe_device(int ordinal);

}  // namespace semfield::cuda
