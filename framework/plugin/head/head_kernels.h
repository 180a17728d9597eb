// What a device computes for a head of one hidden layer.
#pragma once

#include <string>

#include "compute/precision.h"
#include "core/bf16.h"
#include "plugin/layer_weights.h"
#include "plugin/parametric.h"

namespace semfield {

struct HeadShape {
  std::int32_t feature = 0, hidden = 0, width = 0;
  Precision precision = Precision::fp32;         ///< of the hidden layer, a product per sample; the output stays fp32
  std::string output = "class";                  ///< name of the output layer's tensors
  LayerWeight hidden_weight{}, output_weight{};  ///< on a CPU
};

/// The head's learned tensors, in this order.
enum HeadTensor : std::size_t { kHiddenWeight, kHiddenBias, kOutputWeight, kOutputBias };

/// Shapes and meaning are those of Head's calls. A null entry is work that the device has no use for.
template <class Real>
struct HeadKernels {
  /// Of the rearranged tensors, which a device that needs none does not have.
  void (*derive)(const HeadShape& shape, const Tensors<Real>& tensors) = nullptr;
  void (*hidden_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                         View<const Real> feature, View<Real> hidden) = nullptr;
  void (*hidden_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                          View<const Real> feature, View<const Real> hidden, View<Real> d_hidden,
                          View<Real> d_feature) = nullptr;
  void (*output_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> h,
                         View<const Real> opacity, View<Real> rows) = nullptr;
  void (*output_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> h,
                          View<const Real> opacity, View<const Real> d_rows, View<Real> d_h,
                          View<Real> d_opacity) = nullptr;
  /// The hidden layer with feature and activations in bf16; d_hidden is already the gradient before the ReLU. Null
  /// where the device's activations are never bf16.
  void (*rounded_hidden_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                                 View<const Bf16> feature, View<Bf16> hidden) = nullptr;
  void (*rounded_hidden_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                                  View<const Bf16> feature, View<const Bf16> d_hidden, View<Bf16> d_feature) = nullptr;
};

/// Those of the CPU.
template <class Real>
const HeadKernels<Real>& cpu_head_kernels();

}  // namespace semfield
