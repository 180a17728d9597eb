// The generalised cross-entropy on the device: a warp per ray, sums of a row in float64.
#include "cuda/kernels/device_code.cuh"
#include "losses/generalised_cross_entropy/generalised_cross_entropy.h"

namespace semfield::cuda {

namespace {

struct Body {
  double q;
  View<const std::int16_t> label;
  View<const float> soft, logits;
  View<float> d_logits;

  __device__ double operator()(const WarpRay& at, double scale) const {
    if (at.ray >= logits.rows || label.empty()) return 0;
    const std::int32_t hard = label(at.ray, 0);
    if (hard < 0) return 0;
    const float* const row = logits.row(at.ray);
    const RowTop top = top_of_row(row, logits.cols, at.lane);
    if (!top.finite) return 0;  // the guard of logits notes it
    const double total = 1 + rest_of_row<double>(row, logits.cols, top, at.lane);
    double of_soft = 0;
    for (std::int32_t c = at.lane; c < soft.cols && !soft.empty(); c += kWarp)
      of_soft += static_cast<double>(soft(at.ray, c));
    const double soft_sum = soft.empty() ? 1 : warp_sum(of_soft);
    if (!(soft_sum > 0)) return 0;
    const auto share = [&](std::int32_t c) {
      if (soft.empty()) return c == hard ? 1.0 : 0.0;
      return static_cast<double>(soft(at.ray, c)) / soft_sum;
    };
    const auto below = [&](std::int32_t c) { return static_cast<double>(row[c]) - static_cast<double>(top.largest); };
    double loss = 0, of_lane = 0;
    for (std::int32_t c = at.lane; c < logits.cols; c += kWarp) {
      const double t = share(c);
      if (t == 0) continue;
      const double power = power_of_probability(below(c), total, q);
      of_lane += t * power;
      loss += generalised_share(t, power, q);
    }
    const double powers = warp_sum(of_lane);
    for (std::int32_t c = at.lane; c < logits.cols; c += kWarp) {
      const double t = share(c);
      const double power = t == 0 ? 0 : power_of_probability(below(c), total, q);
      const double p = exp(below(c)) / total;
      d_logits(at.ray, c) += static_cast<float>(scale * generalised_slope(p, powers, t, power));
    }
    return loss;
  }
};

void add(const Loss& loss, const LossCall& call) {
  Body body;
  body.q = static_cast<const GeneralisedCrossEntropy&>(loss).params.q;
  body.label = call.targets.label;
  body.soft = call.targets.more[channel::soft_label];
  body.logits = call.values.heads[channel::logits];
  body.d_logits = call.gradients.heads[channel::logits];
  launch_over_rays(call, body, "generalised cross-entropy");
}

const LossKernels<GeneralisedCrossEntropy> kTable{add};

}  // namespace

void generalised_cross_entropy_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "loss 'generalised_cross_entropy'", &kTable);
}

}  // namespace semfield::cuda
