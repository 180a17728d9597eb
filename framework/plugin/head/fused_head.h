// What a field and the head of class logits exchange where their kernels are fused: a field that has none of this is
// whole, and reads no more of it.
#pragma once

#include "core/bf16.h"
#include "core/view.h"

namespace semfield {

/// How a field hands its feature on. Every field can write it in full, FieldOut::feature; the other forms save the
/// bytes between field and head.
enum class FeatureForm : std::uint8_t {
  full,          ///< FieldOut::feature alone
  rounded,       ///< also FusedOut::feature
  hidden_layer,  ///< also FusedOut::hidden: the field computes the head's hidden layer where its feature lies
};

/// The hidden layer of the semantic head, relu(feature W + b).
template <class Real>
struct HiddenLayer {
  View<const Real> weight, bias;  ///< [F, H], [1, H]
  View<Real> d_weight, d_bias;    ///< backward adds to them
};

/// Of M samples; empty: not wanted. At most one of FieldOut::feature and these two is given.
template <class Real>
struct FusedOut {
  View<Bf16> feature;       ///< [M, F]
  View<Bf16> hidden;        ///< [N <= M, H], `layer` of the first N features; wanted together with the colour
  HiddenLayer<Real> layer;  ///< of `hidden`
};

/// dL/d(FusedOut), in the form in which forward gave it.
struct FusedGrad {
  View<const Bf16> feature;  ///< [N <= M, F]; zero for the rows behind
  /// dL/d(hidden) before the ReLU: blocked_rows(N) x H numbers in 8 x 8 blocks of 128 contiguous bytes, blocks of 8
  /// rows one behind the other; zero in the rows behind N. FusedOut::layer has room for the layer's own gradients.
  const Bf16* hidden = nullptr;
};
/// Rows of FusedGrad::hidden: whole tiles of the fields that take it.
constexpr std::int64_t blocked_rows(std::int64_t rows) { return (rows + 255) / 256 * 256; }

}  // namespace semfield
