#include "cuda/loss_terms.h"

#include "core/check.h"
#include "core/error.h"

namespace semfield::cuda {

std::vector<DeviceLoss> loss_kernels(const LossList& losses, const KernelTables* tables) {
  SEMFIELD_CHECK(tables != nullptr || losses.empty(), "losses need kernel tables on a device");
  std::vector<DeviceLoss> found;
  for (const LossEntry& entry : losses.entries())
    found.push_back({entry.loss, entry.loss->kernel(Device::cuda, "loss '" + entry.type + "'", *tables)});
  return found;
}

void add_losses(Workspace& arena, const std::vector<DeviceLoss>& losses, std::uint32_t which, LossCall call,
                LossSums* sums) {
  const std::int64_t rays = call.values.first.rows - 1;
  const Workspace::Scope scope(arena);
  call.of_ray = arena.take<double>(rays, 1).data;
  for (std::size_t i = 0; i < losses.size(); ++i) {
    if ((which >> i & 1U) == 0) continue;
    call.scale = &launch().cell->loss_scale[i];
    losses[i].add(*losses[i].loss, call);
    sum_in_order(call.of_ray, rays, &sums->terms[i]);
  }
}

}  // namespace semfield::cuda
