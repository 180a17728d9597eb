// Adam on the device, twin of the kernels of model/optim/adam.
#pragma once

#include "cuda/launch.h"
#include "model/optim/adam.h"

namespace semfield::cuda {

/// Notes a fault of Stage::gradient (row: number of the tensor) for a value, gradient or moment from which no update
/// may start, over all tensors; limits as first_unsound. Of a touched_only tensor all gradients, and values and moments
/// of the touched rows of one of kTableWindows windows a step, as on the CPU. Nothing is changed.
void check_gradients(const AdamTable<float>& table);

/// As Stages::adam, and zeroes all gradients, unless a fault is noted: then nothing is written. `step` and the table
/// are device memory, so that one launch of a captured graph serves all tensors in every step. The bits of a CPU
/// with fused multiply-add; arrays that start on 16 bytes, and tables of 1, 2, 4 or 8 columns, are the fast case.
void adam_update(const AdamStep* step, const AdamTable<float>& table);

}  // namespace semfield::cuda
