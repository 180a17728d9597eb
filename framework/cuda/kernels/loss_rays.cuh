// What kernels of loss terms share: a warp per ray, and the ray's loss as the sum over its lanes.
#pragma once

#include "cuda/kernels/device_code.cuh"
#include "cuda/stages.h"

namespace semfield::cuda {

/// `body(at, scale)` is called by all lanes of a warp; the lanes' results add up to the ray's loss, in a fixed tree.
template <class Body>
__global__ void __launch_bounds__(kRayThreads)
    loss_of_rays(View<const std::int32_t> first, Body body, const double* scale, double* of_ray) {
  const WarpRay at(first);
  if (!at.exists()) return;
  const double loss = warp_sum(static_cast<double>(body(at, *scale)));
  if (at.lane == 0) of_ray[at.ray] = loss;
}

template <class Body>
void launch_over_rays(const LossCall& call, const Body& body, const char* name) {
  const std::int64_t rays = call.values.first.rows - 1;
  if (rays == 0) return;
  loss_of_rays<<<ray_blocks(rays), kRayThreads, 0, launch().stream>>>(call.values.first, body, call.scale, call.of_ray);
  check_launch(name);
}

}  // namespace semfield::cuda
