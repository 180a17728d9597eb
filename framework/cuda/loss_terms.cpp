#include "cuda/loss_terms.h"

#include <algorithm>

#include "core/error.h"

namespace semfield::cuda {

namespace {

LossKernel kernel_of(const std::string& type) {
  const std::span<const LossKernels> all = loss_kernels();
  const auto found = std::find_if(all.begin(), all.end(), [&](const LossKernels& one) { return one.type == type; });
  if (found != all.end()) return found->add;
  throw Error(ErrorKind::unavailable, "losses: the term '" + type + "' has no CUDA kernels",
              "set runtime.device: cpu, or take the term out of the list `losses`");
}

}  // namespace

void require_loss_kernels(const LossList& losses) {
  for (const LossEntry& entry : losses.entries()) (void)kernel_of(entry.type);
}

void add_losses(Workspace& arena, const LossList& losses, std::uint32_t active, const RayTargets& targets,
                const RayValues<float>& values, const RayGradients<float>& gradients, LossSums* sums) {
  const std::int64_t rays = values.first.rows - 1;
  const Workspace::Scope scope(arena);
  LossCall call{targets, values, gradients, nullptr, arena.take<double>(rays, 1).data};
  for (std::size_t i = 0; i < losses.entries().size(); ++i) {
    if ((active >> i & 1U) == 0) continue;
    const LossEntry& entry = losses.entries()[i];
    call.scale = &launch().cell->loss_scale[i];
    kernel_of(entry.type)(*entry.term, call);
    sum_in_order(call.of_ray, rays, &sums->terms[i]);
  }
}

}  // namespace semfield::cuda
