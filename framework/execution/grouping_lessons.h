// Steps of learning a grouping from points of images, on a device.
#pragma once

#include <cstdint>
#include <functional>
#include <span>

#include "model/optim/adam.h"
#include "model/param_store.h"
#include "plugin/grouping.h"
#include "plugin/mlp/mlp.h"

namespace semfield {

/// Views are host memory. The sum of a step is divided by its points, images * per_image.
struct GroupingLessons {
  const Mlp<float>& network;  ///< built for the device
  const Grouping& grouping;
  GroupingKernel kernel;     ///< of the device
  ParamStore<float>& store;  ///< of the network and of its slow copy, each with the network's tensors alone
  ParamStore<float>& slow;
  int ordinal = 0;
  View<const float> points = {};  ///< [N, inputs] of the network
  std::span<const AdamStep> updates = {};
  std::int64_t images = 0, per_image = 0;  ///< of a step
  /// Gives the points [per_image] of a step's image, and their segments; returns how many the image has. Called from
  /// several threads.
  std::function<std::int32_t(std::int64_t step, std::int64_t image, std::span<std::int32_t> point,
                             std::span<std::int32_t> segment)>
      draw = {};
  std::function<void(double done, double of)> progress = {};  ///< may be null
};

}  // namespace semfield
