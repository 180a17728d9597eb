// Single calls of components on the device: what tests of plugins use.
#pragma once

#include "execution/device_library.h"

namespace semfield::cuda {

/// On the calling thread's device and its default stream.
DeviceCalls device_calls();

}  // namespace semfield::cuda
