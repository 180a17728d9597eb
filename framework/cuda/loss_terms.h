// The list `losses` on the device: each one's kernel, and their sums of a step.
#pragma once

#include <vector>

#include "core/workspace.h"
#include "cuda/kernels/losses.h"
#include "losses/loss_list.h"

namespace semfield::cuda {

/// A loss of the list, and what adds it on the device.
struct DeviceLoss {
  std::shared_ptr<const Loss> loss;
  LossKernel add = nullptr;
};

/// In the order of the list. Throws Error(unavailable) naming the first loss without kernels.
std::vector<DeviceLoss> loss_kernels(const LossList& losses, const KernelTables* tables);
/// Adds gradients of the losses whose bit is set in `which`, scaled by launch().cell; sums->terms gets their sums, in a
/// fixed order. `call` has everything but `scale` and `of_ray`.
void add_losses(Workspace& arena, const std::vector<DeviceLoss>& losses, std::uint32_t which, LossCall call,
                LossSums* sums);

}  // namespace semfield::cuda
