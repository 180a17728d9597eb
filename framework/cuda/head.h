// The semantic head on the device, twin of model/semantic_head.
#pragma once

#include <cuda_bf16.h>

#include "core/gemm.h"
#include "cuda/feature_exchange.h"
#include "cuda/matmul.h"
#include "model/semantic_head.h"

namespace semfield::cuda {

/// Works on the tensors that SemanticHead declares. Views as there, in device memory; everything is queued on
/// launch().stream.
class Head {
 public:
  /// precision: of the hidden layer; the class layer is fp32, of many classes TF32 with Precision::bf16.
  Head(const SemanticHead<float>& host, Precision precision) : host_(host), precision_(precision) {}

  bool rounds() const { return precision_ == Precision::bf16; }
  std::int32_t hidden_width() const { return host_.hidden_width(); }
  std::int32_t classes() const { return host_.classes(); }

  /// What a field needs to compute the hidden layer itself; without room, gradients where the tensors have them.
  HiddenLayer hidden_layer(const Tensors<float>& tensors) const;
  /// hidden [N, H] = relu(feature [N, F] W1 + b1).
  void hidden_forward(Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                      View<float> hidden) const;
  /// d_feature [N, F] = dL/dfeature; d_hidden is overwritten.
  void hidden_backward(Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                       View<const float> hidden, View<float> d_hidden, View<float> d_feature) const;
  /// The same in bf16 from end to end, for Precision::bf16; d_hidden is already the gradient before the ReLU.
  void hidden_forward(Workspace& arena, const Tensors<float>& tensors, View<const __nv_bfloat16> feature,
                      View<__nv_bfloat16> hidden) const;
  void hidden_backward(Workspace& arena, const Tensors<float>& tensors, View<const __nv_bfloat16> feature,
                       View<const __nv_bfloat16> d_hidden, View<__nv_bfloat16> d_feature) const;
  /// logits [N, C] = h W2 + share b2; share empty: 1.
  void class_forward(Workspace& arena, const Tensors<float>& tensors, View<const float> h, View<const float> share,
                     View<float> logits) const;
  /// d_h, and d_share where share is not empty.
  void class_backward(Workspace& arena, const Tensors<float>& tensors, View<const float> h, View<const float> share,
                      View<const float> d_logits, View<float> d_h, View<float> d_share) const;

 private:
  /// d = a b (+ d), a product of the class layer with many classes.
  void large_product(const Matrix& a, const Matrix& b, View<float> d, bool add) const;

  const SemanticHead<float>& host_;
  Precision precision_;
};

}  // namespace semfield::cuda
