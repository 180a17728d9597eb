// The near-density loss on the device: a warp per ray.
#include "cuda/kernels/device_code.cuh"
#include "model/losses/near_density/near_density.h"

namespace semfield::cuda {

namespace {

struct Body {
  double distance_m;
  View<const float> t, delta, sigma;
  View<float> d_sigma;

  __device__ double operator()(const WarpRay& at, double scale) const {
    double sum = 0;
    for (std::int32_t m = at.begin + at.lane; m < at.end; m += kWarp) {
      const LossValue share = near_density_share(t(m, 0), delta(m, 0), sigma(m, 0), distance_m);
      sum += share.value;
      d_sigma(m, 0) += static_cast<float>(scale * share.slope);
    }
    return sum;
  }
};

void add(const Loss& loss, const LossCall& call) {
  const double distance_m = static_cast<const NearDensityLoss&>(loss).params.distance_m;
  const Body body{near_density_reach(distance_m, call.values.unit_m), call.values.t, call.values.delta,
                  call.values.sigma, call.gradients.sigma};
  launch_over_rays(call, body, "near-density loss");
}

const LossKernels<NearDensityLoss> kTable{add};

}  // namespace

void near_density_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "loss 'near_density'", &kTable); }

}  // namespace semfield::cuda
