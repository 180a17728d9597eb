#include "cuda/head.h"

#include <array>

#include "cuda/layers.h"
#include "cuda/matmul.h"

namespace semfield::cuda {

namespace {

constexpr std::int32_t kMostSmallClasses = 128;  // with more, cuBLASLt's kernels are the faster ones

enum Index : std::size_t { kHiddenWeight, kHiddenBias, kClassWeight, kClassBias };

// The same matrix in bf16, in the arena.
View<__nv_bfloat16> rounded(Workspace& arena, View<const float> in) {
  const View<__nv_bfloat16> out = arena.take<__nv_bfloat16>(in.rows, in.cols);
  convert<float, __nv_bfloat16>(in, out);
  return out;
}

template <class Act, class Out>
void layer(View<const Act> x, View<const Act> weight, View<const float> bias, View<Out> y,
           Activation activation = Activation::none) {
  LinearForward<Act, Out> call;
  call.x = x;
  call.weight = weight;
  call.bias = bias;
  call.y = y;
  call.activation = activation;
  linear_forward(call);
}

SmallProduct times(const Matrix& a, const Matrix& b, View<float> d, bool add) {
  SmallProduct product;
  product.a = a;
  product.b = b;
  product.d = d;
  product.add = add;
  return product;
}

}  // namespace

HiddenLayer Head::hidden_layer(const Tensors<float>& tensors) const {
  HiddenLayer layer;
  layer.weight = tensors.value[kHiddenWeight];
  layer.bias = tensors.value[kHiddenBias];
  if (tensors.grad.empty()) return layer;
  layer.d_weight = tensors.grad[kHiddenWeight];
  layer.d_bias = tensors.grad[kHiddenBias];
  return layer;
}

void Head::hidden_forward(Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                          View<float> hidden) const {
  if (feature.rows == 0) return;
  const Workspace::Scope scope(arena);
  const View<const float> weight = tensors.value[kHiddenWeight], bias = tensors.value[kHiddenBias];
  if (precision_ == Precision::bf16) {
    layer<__nv_bfloat16, float>(rounded(arena, feature), rounded(arena, weight), bias, hidden, Activation::relu);
  } else {
    layer<float, float>(feature, weight, bias, hidden, Activation::relu);
  }
}

void Head::hidden_backward(Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                           View<const float> hidden, View<float> d_hidden, View<float> d_feature) const {
  if (feature.rows == 0) return;
  const Workspace::Scope scope(arena);
  const View<const float> weight = tensors.value[kHiddenWeight];
  cuda::relu_backward<float>(hidden, d_hidden);
  if (precision_ == Precision::bf16) {
    LinearBackward<__nv_bfloat16, float> call;
    call.x = rounded(arena, feature);
    call.dz = rounded(arena, d_hidden);
    call.weight = rounded(arena, weight);
    call.d_weight = tensors.grad[kHiddenWeight];
    call.d_bias = tensors.grad[kHiddenBias];
    call.dx = d_feature;
    linear_backward<__nv_bfloat16, float>(call, arena);
  } else {
    LinearBackward<float, float> call;
    call.x = feature;
    call.dz = d_hidden;
    call.weight = weight;
    call.d_weight = tensors.grad[kHiddenWeight];
    call.d_bias = tensors.grad[kHiddenBias];
    call.dx = d_feature;
    linear_backward<float, float>(call, arena);
  }
}

void Head::hidden_forward(Workspace& arena, const Tensors<float>& tensors, View<const __nv_bfloat16> feature,
                          View<__nv_bfloat16> hidden) const {
  if (feature.rows == 0) return;
  const Workspace::Scope scope(arena);
  LinearForward<__nv_bfloat16, __nv_bfloat16> call;
  call.x = feature;
  call.weight = rounded(arena, tensors.value[kHiddenWeight]);
  call.bias = tensors.value[kHiddenBias];
  call.rounded_bias = rounded(arena, tensors.value[kHiddenBias]);
  call.y = hidden;
  call.activation = Activation::relu;
  linear_forward(call);
}

void Head::hidden_backward(Workspace& arena, const Tensors<float>& tensors, View<const __nv_bfloat16> feature,
                           View<const __nv_bfloat16> d_hidden, View<__nv_bfloat16> d_feature) const {
  if (feature.rows == 0) return;
  const Workspace::Scope scope(arena);
  LinearBackward<__nv_bfloat16, __nv_bfloat16> call;
  call.x = feature;
  call.dz = d_hidden;
  call.weight = rounded(arena, tensors.value[kHiddenWeight]);
  call.d_weight = tensors.grad[kHiddenWeight];
  call.d_bias = tensors.grad[kHiddenBias];
  call.dx = d_feature;
  linear_backward(call, arena);
}

void Head::class_forward(Workspace& arena, const Tensors<float>& tensors, View<const float> h, View<const float> share,
                         View<float> logits) const {
  if (h.rows == 0) return;
  const View<const float> weight = tensors.value[kClassWeight], bias = tensors.value[kClassBias];
  if (share.empty()) {
    layer<float, float>(h, weight, bias, logits);
    return;
  }
  // The bias enters as share times its row.
  if (host_.classes() > kMostSmallClasses) {
    shared_bias_forward(share, bias, logits);
    large_product(Matrix(h), Matrix(weight), logits, true);
    return;
  }
  SmallProduct product = times(Matrix(h), Matrix(weight), logits, false);
  product.a2 = Matrix(share);
  product.b2 = Matrix(bias);
  small_products({&product, 1}, &arena);
}

void Head::large_product(const Matrix& a, const Matrix& b, View<float> d, bool add) const {
  Product p;
  p.a = a;
  p.b = b;
  p.d = Matrix(d);
  p.add = add;
  p.tf32 = rounds();
  product(p);
}

void Head::class_backward(Workspace& arena, const Tensors<float>& tensors, View<const float> h, View<const float> share,
                          View<const float> d_logits, View<float> d_h, View<float> d_share) const {
  if (h.rows == 0) return;
  if (share.empty()) {
    LinearBackward<float, float> call;
    call.x = h;
    call.dz = d_logits;
    call.weight = tensors.value[kClassWeight];
    call.d_weight = tensors.grad[kClassWeight];
    call.d_bias = tensors.grad[kClassBias];
    call.dx = d_h;
    linear_backward<float, float>(call, arena);
    return;
  }
  const View<const float> weight = tensors.value[kClassWeight], bias = tensors.value[kClassBias];
  const View<float> d_weight = tensors.grad[kClassWeight], d_bias = tensors.grad[kClassBias];
  if (host_.classes() > kMostSmallClasses) {
    shared_bias_backward({share, bias, d_logits, d_share, d_bias}, arena);
    large_product(Matrix(d_logits), Matrix(weight, true), d_h, false);
    large_product(Matrix(h, true), Matrix(d_logits), d_weight, true);
    return;
  }
  const std::array<SmallProduct, 4> products = {times(Matrix(d_logits), Matrix(weight, true), d_h, false),
                                                times(Matrix(d_logits), Matrix(bias, true), d_share, false),
                                                times(Matrix(h, true), Matrix(d_logits), d_weight, true),
                                                times(Matrix(share, true), Matrix(d_logits), d_bias, true)};
  small_products(products, &arena);
}

}  // namespace semfield::cuda
