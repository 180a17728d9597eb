// The distortion loss on the device: a warp per ray, tiles of 32 samples from either end, sums by prefix in float64.
#include "cuda/kernels/device_code.cuh"
#include "model/losses/distortion/distortion.h"

namespace semfield::cuda {

namespace {

struct Body {
  DistortionSpace space;
  View<const double> near_far;
  View<const float> t, delta, weight;
  View<float> d_weight;

  // DistortionWalk::step of 32 samples at once: lane j's P. `walk` holds what lies behind the tile, and goes on.
  static __device__ double step(DistortionWalk& walk, double place, double own, int lane) {
    const double sum = walk.weight + warp_prefix(own, lane);
    const double before_place = __shfl_up_sync(kFullMask, place, 1), before = __shfl_up_sync(kFullMask, sum, 1);
    const double from = lane == 0 ? walk.place : before_place, behind = lane == 0 ? walk.weight : before;
    const double gap = place > from ? place - from : from - place;
    const double moment = walk.moment + warp_prefix(behind * gap, lane);
    walk.weight = __shfl_sync(kFullMask, sum, kWarp - 1);
    walk.moment = __shfl_sync(kFullMask, moment, kWarp - 1);
    walk.place = __shfl_sync(kFullMask, place, kWarp - 1);
    return moment;
  }

  // 12 B read per sample and walk, 8 B read and written.
  __device__ double operator()(const WarpRay& at, double scale) const {
    if (at.begin == at.end) return 0;
    const DistortionMap map(space, near_far(at.ray, 0), near_far(at.ray, 1));
    const double first_place = map.place(t(at.begin, 0)), last_place = map.place(t(at.end - 1, 0));
    double loss = 0;
    DistortionWalk front;
    for (std::int32_t tile = at.begin; tile < at.end; tile += kWarp) {
      const std::int32_t m = tile + at.lane;
      const bool mine = m < at.end;
      const double w = mine ? static_cast<double>(weight(m, 0)) : 0.0,
                   where = mine ? static_cast<double>(t(m, 0)) : 0.0;
      const double place = mine ? map.place(where) : last_place;
      const double before = step(front, place, w, at.lane);
      if (!mine) continue;
      const double length = map.length(where, static_cast<double>(delta(m, 0)));
      loss += w * (2 * before + w * length / 3);
      d_weight(m, 0) += static_cast<float>(scale * 2 * (before + w * length / 3));
    }
    DistortionWalk back;
    for (std::int32_t tile = at.end; tile > at.begin; tile -= kWarp) {
      const std::int32_t m = tile - 1 - at.lane;
      const bool mine = m >= at.begin;
      const double w = mine ? static_cast<double>(weight(m, 0)) : 0.0;
      const double place = mine ? map.place(static_cast<double>(t(m, 0))) : first_place;
      const double behind = step(back, place, w, at.lane);
      if (mine) d_weight(m, 0) += static_cast<float>(scale * 2 * behind);
    }
    return loss;
  }
};

void add(const Loss& loss, const LossCall& call) {
  const Body body{static_cast<const DistortionLoss&>(loss).params.space,
                  call.values.near_far,
                  call.values.t,
                  call.values.delta,
                  call.values.weight,
                  call.gradients.weight};
  launch_over_rays(call, body, "distortion loss");
}

const LossKernels<DistortionLoss> kTable{add};

}  // namespace

void distortion_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "loss 'distortion'", &kTable); }

}  // namespace semfield::cuda
