// Adam on the device, twin of optim/adam.
#pragma once

#include "core/view.h"
#include "cuda/launch.h"
#include "optim/adam.h"

namespace semfield::cuda {

/// A tensor's arrays as one flat range of floats.
struct AdamTensor {
  float *value = nullptr, *grad = nullptr, *moment1 = nullptr, *moment2 = nullptr;
  std::int64_t rows = 0;
  std::int32_t cols = 0;
  bool touched_only = false;  ///< rows without a gradient are not written
  bool semantic = false;      ///< left alone in a step without labels
  double rate = 1;            ///< LearningRule::rate
  double decay = 0;           ///< LearningRule::rate * LearningRule::decay; of dense tensors
};

/// Notes a fault of Stage::gradient (row: number of the tensor) for a value, gradient or moment from which no update
/// may start, over all tensors; limits as first_unsound. Of a touched_only tensor all gradients, and values and moments
/// of the touched rows of one of kTableWindows windows a step, as Trainer does. Nothing is changed. `total`: rows *
/// cols of all tensors summed.
void check_gradients(const AdamTensor* tensors, int count, std::int64_t total);

/// Updates all tensors with the step's rule (beta1, beta2 and epsilon by value; step size and root scale from
/// launch().cell) and zeroes gradients, unless a fault is noted: then nothing is written. `tensors` is device memory,
/// so that one launch serves all of them. The bits of a processor with fused multiply-add; arrays that start on 16
/// bytes, and tables of 1, 2, 4 or 8 columns, are the fast case.
void adam_update(const AdamParams& rule, const AdamTensor* tensors, int count, std::int64_t total);

}  // namespace semfield::cuda
