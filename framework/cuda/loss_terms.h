// Terms of the list `losses` on the device: kernels by type, and their sums of a step.
#pragma once

#include <span>
#include <string_view>

#include "core/workspace.h"
#include "cuda/kernels/losses.h"
#include "losses/loss_list.h"

namespace semfield::cuda {

/// One call of a term; all views and pointers are device memory.
struct LossCall {
  RayTargets targets;
  RayValues<float> values;
  RayGradients<float> gradients;
  const double* scale = nullptr;  ///< LossScales::scale of the term
  double* of_ray = nullptr;       ///< [R] gets each ray's loss, 0 for a ray that does not count
};

/// As LossTerm::add, queued on launch().stream.
using LossKernel = void (*)(const LossTerm& term, const LossCall& call);
struct LossKernels {
  std::string_view type;
  LossKernel add;
};
/// Of every term with a NAME_cuda.cu; the build writes the list.
std::span<const LossKernels> loss_kernels();

/// Throws Error(unavailable) naming the first term of the list without kernels.
void require_loss_kernels(const LossList& losses);
/// Adds gradients of the terms whose bit is set in `active`, scaled by launch().cell; sums->terms gets their sums, in a
/// fixed order.
void add_losses(Workspace& arena, const LossList& losses, std::uint32_t active, const RayTargets& targets,
                const RayValues<float>& values, const RayGradients<float>& gradients, LossSums* sums);

}  // namespace semfield::cuda
