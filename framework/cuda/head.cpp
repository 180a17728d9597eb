// Heads of one hidden layer on the device. Everything is queued on launch().stream.
#include <array>

#include "cuda/bf16.h"
#include "cuda/kernel_tables.h"
#include "cuda/kernels/layers.h"
#include "cuda/matmul.h"
#include "cuda/stages.h"

namespace semfield::cuda {

namespace {

constexpr std::int32_t kMostSmallClasses = 128;  // with more, cuBLASLt's kernels are the faster ones

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

void hidden_forward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                    View<float> hidden) {
  const Workspace::Scope scope(arena);
  const View<const float> weight = tensors.value[kHiddenWeight], bias = tensors.value[kHiddenBias];
  if (shape.precision == Precision::bf16) {
    layer<__nv_bfloat16, float>(rounded(arena, feature), rounded(arena, weight), bias, hidden, Activation::relu);
  } else {
    layer<float, float>(feature, weight, bias, hidden, Activation::relu);
  }
}

template <class Act, class Dx>
void layer_backward(Workspace& arena, const Tensors<float>& tensors, const LinearBackward<Act, Dx>& operands) {
  LinearBackward<Act, Dx> call = operands;
  call.d_weight = tensors.grad[kHiddenWeight];
  call.d_bias = tensors.grad[kHiddenBias];
  linear_backward<Act, Dx>(call, arena);
}

void hidden_backward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors, View<const float> feature,
                     View<const float> hidden, View<float> d_hidden, View<float> d_feature) {
  const Workspace::Scope scope(arena);
  const View<const float> weight = tensors.value[kHiddenWeight];
  cuda::relu_backward<float>(hidden, d_hidden);
  if (shape.precision == Precision::bf16) {
    LinearBackward<__nv_bfloat16, float> call;
    call.x = rounded(arena, feature);
    call.dz = rounded(arena, d_hidden);
    call.weight = rounded(arena, weight);
    call.dx = d_feature;
    layer_backward(arena, tensors, call);
  } else {
    LinearBackward<float, float> call;
    call.x = feature;
    call.dz = d_hidden;
    call.weight = weight;
    call.dx = d_feature;
    layer_backward(arena, tensors, call);
  }
}

void rounded_hidden_forward(const HeadShape&, Workspace& arena, const Tensors<float>& tensors, View<const Bf16> feature,
                            View<Bf16> hidden) {
  const Workspace::Scope scope(arena);
  LinearForward<__nv_bfloat16, __nv_bfloat16> call;
  call.x = as_bf16(feature);
  call.weight = rounded(arena, tensors.value[kHiddenWeight]);
  call.bias = tensors.value[kHiddenBias];
  call.rounded_bias = rounded(arena, tensors.value[kHiddenBias]);
  call.y = as_bf16(hidden);
  call.activation = Activation::relu;
  linear_forward(call);
}

void rounded_hidden_backward(const HeadShape&, Workspace& arena, const Tensors<float>& tensors,
                             View<const Bf16> feature, View<const Bf16> d_hidden, View<Bf16> d_feature) {
  const Workspace::Scope scope(arena);
  LinearBackward<__nv_bfloat16, __nv_bfloat16> call;
  call.x = as_bf16(feature);
  call.dz = as_bf16(d_hidden);
  call.weight = rounded(arena, tensors.value[kHiddenWeight]);
  call.dx = as_bf16(d_feature);
  layer_backward(arena, tensors, call);
}

/// d = a b (+ d), a product of the class layer with many classes: TF32 where the head computes in bf16.
void large_product(const HeadShape& shape, const Matrix& a, const Matrix& b, View<float> d, bool add) {
  Product p;
  p.a = a;
  p.b = b;
  p.d = Matrix(d);
  p.add = add;
  p.tf32 = shape.precision == Precision::bf16;
  product(p);
}

void output_forward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors, View<const float> h,
                    View<const float> share, View<float> logits) {
  const View<const float> weight = tensors.value[kOutputWeight], bias = tensors.value[kOutputBias];
  if (share.empty()) {
    layer<float, float>(h, weight, bias, logits);
    return;
  }
  // The bias enters as share times its row.
  if (shape.width > kMostSmallClasses) {
    shared_bias_forward(share, bias, logits);
    large_product(shape, Matrix(h), Matrix(weight), logits, true);
    return;
  }
  SmallProduct product = times(Matrix(h), Matrix(weight), logits, false);
  product.a2 = Matrix(share);
  product.b2 = Matrix(bias);
  small_products({&product, 1}, &arena);
}

void output_backward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors, View<const float> h,
                     View<const float> share, View<const float> d_logits, View<float> d_h, View<float> d_share) {
  const View<const float> weight = tensors.value[kOutputWeight], bias = tensors.value[kOutputBias];
  const View<float> d_weight = tensors.grad[kOutputWeight], d_bias = tensors.grad[kOutputBias];
  if (share.empty()) {
    LinearBackward<float, float> call;
    call.x = h;
    call.dz = d_logits;
    call.weight = weight;
    call.d_weight = d_weight;
    call.d_bias = d_bias;
    call.dx = d_h;
    linear_backward<float, float>(call, arena);
    return;
  }
  if (shape.width > kMostSmallClasses) {
    const Workspace::Scope scope(arena);
    if (d_share.empty()) d_share = arena.take<float>(share.rows, 1);
    shared_bias_backward({share, bias, d_logits, d_share, d_bias}, arena);
    large_product(shape, Matrix(d_logits), Matrix(weight, true), d_h, false);
    large_product(shape, Matrix(h, true), Matrix(d_logits), d_weight, true);
    return;
  }
  const std::array<SmallProduct, 4> products = {times(Matrix(d_logits), Matrix(weight, true), d_h, false),
                                                times(Matrix(h, true), Matrix(d_logits), d_weight, true),
                                                times(Matrix(share, true), Matrix(d_logits), d_bias, true),
                                                times(Matrix(d_logits), Matrix(bias, true), d_share, false)};
  small_products(std::span(products).first(d_share.empty() ? 3 : 4), &arena);
}

}  // namespace

const HeadKernels<float>& head_kernels() {
  static constexpr HeadKernels<float> kernels{
      nullptr,         hidden_forward,         hidden_backward,        output_forward,
      output_backward, rounded_hidden_forward, rounded_hidden_backward};
  return kernels;
}

void add_head_kernels(KernelTables& tables) { tables.add(Device::cuda, kHeadOwner, &head_kernels()); }

}  // namespace semfield::cuda
