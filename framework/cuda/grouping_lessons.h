// Learning a grouping on the device.
#pragma once

#include "execution/device_library.h"

namespace semfield::cuda {

/// As DeviceLibrary::learn_grouping. A step is a gather of its points, the network forward, its slow copy forward where
/// there is one, the grouping's kernel, the network backward and Adam, all queued; draws of many steps are sent at
/// once.
void learn_grouping(const GroupingLessons& lessons);

/// slow = share * slow + (1 - share) * value.
void follow(std::span<const float> value, std::span<float> slow, double share);

}  // namespace semfield::cuda
