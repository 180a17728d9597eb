// The part of compositing that has many channels: sums of hidden channels along rays, and their gradients.
#pragma once

#include <cuda_bf16.h>

#include "model/compositor.h"

namespace semfield::cuda {

/// out [n, H] = sum of w h over the samples of the first n rays. hidden [M, H], Act float or __nv_bfloat16.
template <class Act>
void hidden_forward(const Samples<float>& samples, View<const float> weight, View<const Act> hidden, View<float> out);

/// d_hidden = w dL/d(out) for samples of the first d_out.rows rays, 0 in its rows behind them; with relu_output where
/// hidden > 0 alone: the gradient before the ReLU that made it. dots [M, 1], where it is not empty: dL/d(out) . h of
/// those samples; its other rows are left alone.
template <class Act>
struct HiddenBackward {
  View<const float> weight;
  View<const Act> hidden;
  View<const float> d_out;
  View<float> dots;
  View<Act> d_hidden;  ///< may have more rows than `hidden`
  bool relu_output = false;
  /// d_hidden lies in 8 x 8 blocks (FusedGrad::hidden): contiguous, rows and columns multiples of 8.
  bool blocked = false;
};
template <class Act>
void hidden_backward(const Samples<float>& samples, const HiddenBackward<Act>& call);

}  // namespace semfield::cuda
