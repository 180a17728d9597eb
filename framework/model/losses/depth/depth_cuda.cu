// The depth loss on the device: a warp per ray.
#include "cuda/kernels/device_code.cuh"
#include "model/losses/depth/depth.h"

namespace semfield::cuda {

namespace {

struct Body {
  DepthLossParams params;  // its band with a number
  double unit_m;
  View<const float> truth, depth, t, weight;
  View<float> d_depth, d_weight;

  __device__ double operator()(const WarpRay& at, double scale) const {
    const double of_ray = truth.empty() ? 0 : static_cast<double>(truth(at.ray, 0));
    if (!(of_ray > 0)) return 0;
    if (params.kind == DepthLossKind::expected) {
      if (at.lane != 0) return 0;
      const LossValue loss = expected_depth_loss(depth(at.ray, 0), of_ray, params.truncate_m, unit_m);
      d_depth(at.ray, 0) += static_cast<float>(scale * loss.slope);
      return loss.value;
    }
    double sum = at.lane == 0 ? 1 : 0;
    for (std::int32_t m = at.begin + at.lane; m < at.end; m += kWarp) {
      const LossValue share = line_of_sight_share(t(m, 0), weight(m, 0), of_ray, params.band_m);
      sum += share.value;
      d_weight(m, 0) += static_cast<float>(scale * share.slope);
    }
    return sum;
  }
};

void add(const Loss& loss, const LossCall& call) {
  DepthLossParams params = static_cast<const DepthLoss&>(loss).params;
  params.band_m = band_of(params.band_m, call.values.unit_m);
  const Body body{params,
                  call.values.unit_m,
                  call.targets.more[channel::depth],
                  call.values.depth,
                  call.values.t,
                  call.values.weight,
                  call.gradients.depth,
                  call.gradients.weight};
  launch_over_rays(call, body, "depth loss");
}

const LossKernels<DepthLoss> kTable{add};

}  // namespace

void depth_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "loss 'depth'", &kTable); }

}  // namespace semfield::cuda
