// The silhouette loss on the device: a warp per ray.
#include "cuda/kernels/device_code.cuh"
#include "losses/silhouette/silhouette.h"

namespace semfield::cuda {

namespace {

struct Body {
  View<const float> alpha, opacity;
  View<float> d_weight;

  __device__ double operator()(const WarpRay& at, double scale) const {
    const double wanted = alpha.empty() ? -1 : static_cast<double>(alpha(at.ray, 0));
    if (!(wanted >= 0) || at.begin == at.end) return 0;
    const LossValue share = silhouette_share(opacity(at.ray, 0), wanted);
    for (std::int32_t m = at.begin + at.lane; m < at.end; m += kWarp)
      d_weight(m, 0) += static_cast<float>(scale * share.slope);
    return at.lane == 0 ? share.value : 0;
  }
};

void add(const Loss&, const LossCall& call) {
  const Body body{call.targets.more[channel::alpha], call.values.opacity, call.gradients.weight};
  launch_over_rays(call, body, "silhouette loss");
}

const LossKernels<SilhouetteLoss> kTable{add};

}  // namespace

void silhouette_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "loss 'silhouette'", &kTable); }

}  // namespace semfield::cuda
