// What a field and the semantic head hand each other in bf16 without a copy in fp32.
#pragma once

#include <cuda_bf16.h>

#include "core/view.h"

namespace semfield::cuda {

/// A field with bf16 activations may leave its feature where it keeps it for backward, and take the gradient in bf16.
/// The pass puts one of these into the launch of a training step; fields that know nothing of it use FieldOut and
/// FieldGrad.
struct FeatureExchange {
  View<__nv_bfloat16> room;           ///< [M, F] for fields that do not keep their feature as a matrix
  View<const __nv_bfloat16> feature;  ///< [M, F], set by the field's forward, which then leaves FieldOut::feature alone
  View<const __nv_bfloat16> d_feature;  ///< [N <= M, F], set before the field's backward, instead of
                                        ///< FieldGrad::feature; 0 for the rows behind it
};

}  // namespace semfield::cuda
