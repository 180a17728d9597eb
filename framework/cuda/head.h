// The semantic head on the device, twin of model/semantic_head.
#pragma once

#include "core/gemm.h"
#include "model/semantic_head.h"

namespace semfield::cuda {

/// Works on the tensors that SemanticHead declares. Views as there, in device memory; everything is queued on
/// launch().stream.
class Head {
 public:
  /// precision: of the hidden layer; the class layer stays fp32.
  Head(const SemanticHead<float>& host, Precision precision) : host_(host), precision_(precision) {}

  std::int32_t hidden_width() const { return host_.hidden_width(); }
  std::int32_t classes() const { return host_.classes(); }

  /// hidden [N, H] = relu(feature [N, F] W1 + b1).
  void hidden_forward(Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                      View<float> hidden) const;
  /// d_feature [N, F] = dL/dfeature; d_hidden is overwritten.
  void hidden_backward(Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                       View<const float> hidden, View<float> d_hidden, View<float> d_feature) const;
  /// logits [N, C] = h W2 + share b2; share empty: 1.
  void class_forward(const Tensors<float>& tensors, View<const float> h, View<const float> share,
                     View<float> logits) const;
  /// d_h, and d_share when not empty.
  void class_backward(Workspace& arena, const Tensors<float>& tensors, View<const float> h, View<const float> share,
                      View<const float> d_logits, View<float> d_h, View<float> d_share) const;

 private:
  const SemanticHead<float>& host_;
  Precision precision_;
};

}  // namespace semfield::cuda
