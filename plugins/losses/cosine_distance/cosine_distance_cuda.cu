// The cosine distance on the device: a warp per ray, sums of a row in float64.
#include "cuda/kernels/device_code.cuh"
#include "losses/cosine_distance/cosine_distance.h"

namespace semfield::cuda {

namespace {

struct Body {
  View<const float> target, made;
  View<float> d_made;

  __device__ double operator()(const WarpRay& at, double scale) const {
    if (at.ray >= made.rows || target.empty()) return 0;
    double of_target = 0, of_made = 0, of_both = 0;
    for (std::int32_t c = at.lane; c < made.cols; c += kWarp) {
      const double t = target(at.ray, c), m = made(at.ray, c);
      of_target += t * t;
      of_made += m * m;
      of_both += t * m;
    }
    const double target_square = warp_sum(of_target), made_square = warp_sum(of_made), product = warp_sum(of_both);
    if (!(target_square > 0)) return 0;
    const RowAngle angle = row_angle(target_square, made_square, product);
    for (std::int32_t c = at.lane; c < made.cols; c += kWarp)
      d_made(at.ray, c) -= static_cast<float>(angle.slope(scale, target(at.ray, c), made(at.ray, c)));
    return at.lane == 0 ? 1 - angle.cosine : 0;
  }
};

void add(const Loss& loss, const LossCall& call) {
  const std::string& channel = static_cast<const CosineDistance&>(loss).params.channel;
  Body body;
  body.target = call.targets.more[channel];
  body.made = call.values.heads[channel];
  body.d_made = call.gradients.heads[channel];
  launch_over_rays(call, body, "cosine distance");
}

const LossKernels<CosineDistance> kTable{add};

}  // namespace

void cosine_distance_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "loss 'cosine_distance'", &kTable); }

}  // namespace semfield::cuda
