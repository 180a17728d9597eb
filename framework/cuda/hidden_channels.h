// The part of compositing that has many channels: sums of hidden channels along rays, and their gradients.
#pragma once

#include "model/compositor.h"

namespace semfield::cuda {

/// out [n, H] = sum of w h over the samples of the first n rays.
void hidden_forward(const Samples<float>& samples, View<const float> weight, View<const float> hidden, View<float> out);

/// d_hidden = w dL/d(out) for samples of the first d_out.rows rays, 0 in its rows behind them. dots [M, 1], where it is
/// not empty: dL/d(out) . h of those samples; its other rows are left alone.
void hidden_backward(const Samples<float>& samples, View<const float> weight, View<const float> hidden,
                     View<const float> d_out, View<float> dots, View<float> d_hidden);

}  // namespace semfield::cuda
