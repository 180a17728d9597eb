// What a device computes for the semantic head.
#pragma once

#include "compute/precision.h"
#include "core/bf16.h"
#include "plugin/layer_weights.h"
#include "plugin/parametric.h"

namespace semfield {

struct HeadShape {
  std::int32_t feature = 0, hidden = 0, classes = 0;
  Precision precision = Precision::fp32;        ///< of the hidden layer, a product a sample; the class layer stays fp32
  LayerWeight hidden_weight{}, class_weight{};  ///< on a processor
};

/// The head's learned tensors, in this order.
enum HeadTensor : std::size_t { kHiddenWeight, kHiddenBias, kClassWeight, kClassBias };

/// Shapes and meaning are those of SemanticHead's calls. A null entry is work that the device has no use for.
template <class Real>
struct HeadKernels {
  /// Of the rearranged tensors, which a device that needs none does not have.
  void (*derive)(const HeadShape& shape, const Tensors<Real>& tensors) = nullptr;
  void (*hidden_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                         View<const Real> feature, View<Real> hidden) = nullptr;
  void (*hidden_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                          View<const Real> feature, View<const Real> hidden, View<Real> d_hidden,
                          View<Real> d_feature) = nullptr;
  void (*class_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> h,
                        View<const Real> share, View<Real> logits) = nullptr;
  void (*class_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> h,
                         View<const Real> share, View<const Real> d_logits, View<Real> d_h,
                         View<Real> d_share) = nullptr;
  /// The hidden layer with feature and activations in bf16; d_hidden is already the gradient before the ReLU. Null
  /// where the device's activations are never bf16.
  void (*rounded_hidden_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                                 View<const Bf16> feature, View<Bf16> hidden) = nullptr;
  void (*rounded_hidden_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                                  View<const Bf16> feature, View<const Bf16> d_hidden, View<Bf16> d_feature) = nullptr;
};

/// Those of the processor.
template <class Real>
const HeadKernels<Real>& processor_head_kernels();

}  // namespace semfield
