// What a field and the semantic head hand each other in bf16 without a copy in fp32, or without any.
#pragma once

#include <cuda_bf16.h>

#include "core/view.h"

namespace semfield::cuda {

/// The semantic head's hidden layer, relu(feature W + b), for a field that computes it where its feature lies.
struct HiddenLayer {
  View<const float> weight, bias;  ///< [F, H], [1, H]
  View<float> d_weight, d_bias;    ///< backward adds to them
  View<__nv_bfloat16> hidden;      ///< [N <= M, H]: room for the rows that are wanted
  /// Gradient before the ReLU, in 8 x 8 blocks of 128 contiguous bytes, blocks of 8 rows one behind the other:
  /// blocked_rows(N) rows, 0 behind the last in use.
  const __nv_bfloat16* d_hidden = nullptr;
};
/// Whole tiles of the fields that take such gradients.
constexpr std::int64_t blocked_rows(std::int64_t rows) { return (rows + 255) / 256 * 256; }

/// A field with bf16 activations may leave its feature where it keeps it for backward, and take the gradient in bf16.
/// The pass puts one of these into the launch of a training step; fields that know nothing of it use FieldOut and
/// FieldGrad.
struct FeatureExchange {
  View<__nv_bfloat16> room;           ///< [M, F] for fields that do not keep their feature as a matrix
  View<const __nv_bfloat16> feature;  ///< [M, F], set by the field's forward, which then leaves FieldOut::feature alone
  View<const __nv_bfloat16> d_feature;  ///< [N <= M, F], set before the field's backward, instead of
                                        ///< FieldGrad::feature; 0 for the rows behind it
  /// A forward that sets hidden_is_done has written layer.hidden, and leaves the feature alone, `room` too: both may
  /// share memory. Its backward takes layer.d_hidden instead of d_feature.
  HiddenLayer layer;
  bool hidden_is_done = false;
};

}  // namespace semfield::cuda
