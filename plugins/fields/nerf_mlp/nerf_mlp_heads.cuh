// The narrow ends of the NeRF network on the device: density, feature and colour, one pass over the activations each.
#pragma once

#include <cuda_bf16.h>

#include "core/view.h"
#include "core/workspace.h"

namespace semfield::cuda {

/// sigma [M, 1] = h w + b and feature [M, width] = h in fp32; either may be empty. h [M, >= width], padding 0; weight
/// [width, 1], bias [1, 1].
template <class Act>
struct DensityHead {
  View<const Act> h;
  View<const float> weight, bias;
  View<float> sigma, feature;
};
template <class Act>
void density_forward(const DensityHead<Act>& call);

/// dh [M, as h] = d_feature + d_sigma w^T, where h > 0 if `masked`; d_weight += h^T d_sigma, d_bias += sum of d_sigma.
template <class Act>
struct DensityHeadGrad {
  View<const Act> h;
  View<const float> weight, d_sigma, d_feature;
  View<const Act> d_rounded_feature;  ///< instead of d_feature; rows behind its last count as 0
  View<float> d_weight, d_bias;
  View<Act> dh;
  bool masked = false;
};
template <class Act>
void density_backward(const DensityHeadGrad<Act>& call, Workspace& arena);

/// rgb = sigmoid(v W + b). With a ray term [R, view] v becomes relu(v + ray_term[ray_of_sample]) first, in place.
template <class Act>
struct ColorHead {
  View<Act> v;
  View<const float> ray_term;
  View<const std::int32_t> ray_of_sample;
  View<const float> weight, bias;
  View<float> rgb;
};
template <class Act>
void color_forward(const ColorHead<Act>& call);

/// dv = (d_rgb rgb (1 - rgb)) W^T where v > 0; d_weight, d_bias +=.
template <class Act>
struct ColorHeadGrad {
  View<const Act> v;
  View<const float> weight, rgb, d_rgb;
  View<float> d_weight, d_bias;
  View<Act> dv;
};
template <class Act>
void color_backward(const ColorHeadGrad<Act>& call, Workspace& arena);

}  // namespace semfield::cuda
