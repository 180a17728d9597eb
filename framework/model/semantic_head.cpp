#include "model/semantic_head.h"

#include <cmath>

#include "core/linear.h"

namespace semfield {

namespace {
enum Index : std::size_t { kHiddenWeight, kHiddenBias, kClassWeight, kClassBias, kHiddenWeightT, kClassWeightT };
}  // namespace

template <class Real>
SemanticHead<Real>::SemanticHead(std::int32_t feature_dims, std::int32_t hidden_width, std::int32_t classes,
                                 Precision precision)
    : feature_(feature_dims), hidden_(hidden_width), classes_(classes), precision_(precision) {}

template <class Real>
void SemanticHead<Real>::declare(ParamDeclarer& declarer) const {
  const Init hidden_init = Init::uniform(1 / std::sqrt(static_cast<double>(feature_)));
  const Init class_init = Init::uniform(1 / std::sqrt(static_cast<double>(hidden_)));
  declarer.tensor({"hidden/weight", feature_, hidden_, hidden_init, TensorRole::dense});
  declarer.tensor({"hidden/bias", 1, hidden_, hidden_init, TensorRole::dense});
  declarer.tensor({"class/weight", hidden_, classes_, class_init, TensorRole::dense});
  declarer.tensor({"class/bias", 1, classes_, class_init, TensorRole::dense});
  declarer.tensor({"hidden/weight_t", hidden_, feature_, {}, TensorRole::derived});
  declarer.tensor({"class/weight_t", classes_, hidden_, {}, TensorRole::derived});
}

template <class Real>
void SemanticHead<Real>::derive(const StepContext&, const Tensors<Real>& tensors) const {
  transpose<Real>(tensors.value[kHiddenWeight], tensors.value[kHiddenWeightT]);
  transpose<Real>(tensors.value[kClassWeight], tensors.value[kClassWeightT]);
}

template <class Real>
void SemanticHead<Real>::hidden_forward(const StepContext&, const Tensors<Real>& tensors, View<const Real> feature,
                                        View<Real> hidden) const {
  linear_forward<Real>(feature, tensors.value[kHiddenWeight], tensors.value[kHiddenBias], Activation::relu, hidden,
                       precision_);
}

template <class Real>
void SemanticHead<Real>::hidden_backward(const StepContext&, const Tensors<Real>& tensors, View<const Real> feature,
                                         View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const {
  LinearGrad<Real> grad;
  grad.weight_t = tensors.value[kHiddenWeightT];
  grad.d_weight = tensors.grad[kHiddenWeight];
  grad.d_bias = tensors.grad[kHiddenBias];
  grad.dx = d_feature;
  grad.precision = precision_;
  linear_backward<Real>(Activation::relu, feature, hidden, d_hidden, grad);
}

template <class Real>
void SemanticHead<Real>::class_forward(const StepContext&, const Tensors<Real>& tensors, View<const Real> h,
                                       View<const Real> share, View<Real> logits) const {
  const View<const Real> bias = tensors.value[kClassBias];
  if (share.empty()) {
    linear_forward<Real>(h, tensors.value[kClassWeight], bias, Activation::none, logits);
    return;
  }
  gemm<Real>(share, bias, logits);
  linear_forward_add<Real>(h, tensors.value[kClassWeight], Activation::none, logits);
}

template <class Real>
void SemanticHead<Real>::class_backward(const StepContext&, const Tensors<Real>& tensors, View<const Real> h,
                                        View<const Real> share, View<const Real> d_logits, View<Real> d_h,
                                        View<Real> d_share) const {
  LinearGrad<Real> grad;
  grad.weight_t = tensors.value[kClassWeightT];
  grad.d_weight = tensors.grad[kClassWeight];
  grad.d_bias = share.empty() ? tensors.grad[kClassBias] : View<Real>();
  grad.dx = d_h;
  linear_backward<Real>(h, d_logits, grad);
  if (share.empty()) return;
  gemm_at_b_add<Real>(share, d_logits, tensors.grad[kClassBias]);
  if (d_share.empty()) return;
  const View<Real> bias = tensors.value[kClassBias];
  gemm<Real>(d_logits, View<const Real>(bias.data, classes_, 1), d_share);
}

template class SemanticHead<float>;
template class SemanticHead<double>;

}  // namespace semfield
