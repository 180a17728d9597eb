#include "plugin/head.h"

#include <cmath>
#include <type_traits>

#include "compute/gemm.h"
#include "compute/layers.h"

namespace semfield {

// A head of one hidden layer on the CPU.

namespace {

using namespace SEMFIELD_ISA;  // the rearranged weights, of this file

/// body.operator()<Activation>() with what the hidden layer computes with.
template <class Real, class Body>
void with_activation(const HeadShape& shape, const Body& body) {
  if constexpr (std::is_same_v<Real, float>) {
    if (shape.precision == Precision::bf16) return body.template operator()<Bf16>();
  }
  body.template operator()<Real>();
}

template <class Real>
void derive(const HeadShape& shape, const Tensors<Real>& tensors) {
  with_activation<Real>(shape, [&]<class Act>() { rearrange<Act>(shape.hidden_weight, tensors); });
  rearrange<Real>(shape.output_weight, tensors);
}

/// h = relu(feature W1 + b1), to be given its result.
template <class Act>
Layer<Act> hidden_layer(const HeadShape& shape, const Tensors<SumOf<Act>>& tensors, View<const Act> feature) {
  return {.x = feature,
          .weight = forward_weight<Act>(shape.hidden_weight, tensors),
          .start = tensors.value[kHiddenBias],
          .relu = true};
}

/// The gradients of the layer and, to be given its result, dz W1^T.
template <class Act>
Layer<Act> hidden_gradient(const HeadShape& shape, const Tensors<SumOf<Act>>& tensors, View<const Act> feature,
                           View<const Act> dz) {
  weight_gradient(feature, dz, tensors.grad[kHiddenWeight], tensors.grad[kHiddenBias]);
  return {.x = dz, .weight = backward_weight<Act>(shape.hidden_weight, tensors)};
}

template <class Real>
void hidden_forward(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> feature,
                    View<Real> hidden) {
  const Workspace::Scope scope(arena);
  with_activation<Real>(shape, [&]<class Act>() {
    Layer<Act> layer = hidden_layer<Act>(shape, tensors, as_input<Act>(feature, arena));
    layer.exact = hidden;
    apply(layer);
  });
}

template <class Real>
void hidden_backward(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> feature,
                     View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) {
  const Workspace::Scope scope(arena);
  relu_backward<Real>(hidden, d_hidden);
  with_activation<Real>(shape, [&]<class Act>() {
    const View<const Act> dz = as_input<Act>(d_hidden, arena);
    Layer<Act> layer = hidden_gradient<Act>(shape, tensors, as_input<Act>(feature, arena), dz);
    layer.exact = d_feature;
    if (!d_feature.empty()) apply(layer);
  });
}

void rounded_hidden_forward(const HeadShape& shape, Workspace&, const Tensors<float>& tensors, View<const Bf16> feature,
                            View<Bf16> hidden) {
  Layer<Bf16> layer = hidden_layer<Bf16>(shape, tensors, feature);
  layer.y = hidden;
  apply(layer);
}

void rounded_hidden_backward(const HeadShape& shape, Workspace&, const Tensors<float>& tensors,
                             View<const Bf16> feature, View<const Bf16> d_hidden, View<Bf16> d_feature) {
  Layer<Bf16> layer = hidden_gradient<Bf16>(shape, tensors, feature, d_hidden);
  layer.y = d_feature;
  apply(layer);
}

template <class Real>
void output_forward(const HeadShape&, Workspace&, const Tensors<Real>& tensors, View<const Real> h,
                    View<const Real> opacity, View<Real> rows) {
  Layer<Real> layer{.x = h, .weight = tensors.value[kOutputWeight], .start = tensors.value[kOutputBias], .exact = rows};
  if (!opacity.empty()) {
    gemm<Real>(opacity, tensors.value[kOutputBias], rows);
    layer.start = rows;
  }
  apply(layer);
}

template <class Real>
void output_backward(const HeadShape& shape, Workspace&, const Tensors<Real>& tensors, View<const Real> h,
                     View<const Real> opacity, View<const Real> d_rows, View<Real> d_h, View<Real> d_opacity) {
  weight_gradient(h, d_rows, tensors.grad[kOutputWeight], opacity.empty() ? tensors.grad[kOutputBias] : View<Real>());
  apply(Layer<Real>{.x = d_rows, .weight = backward_weight<Real>(shape.output_weight, tensors), .exact = d_h});
  if (opacity.empty()) return;
  gemm_at_b_add<Real>(opacity, d_rows, tensors.grad[kOutputBias]);
  if (d_opacity.empty()) return;
  const View<Real> bias = tensors.value[kOutputBias];
  gemm<Real>(d_rows, View<const Real>(bias.data, shape.width, 1), d_opacity);
}

}  // namespace

template <class Real>
const HeadKernels<Real>& cpu_head_kernels() {
  static constexpr HeadKernels<Real> kernels = [] {
    HeadKernels<Real> table{derive<Real>, hidden_forward<Real>, hidden_backward<Real>, output_forward<Real>,
                            output_backward<Real>};
    if constexpr (std::is_same_v<Real, float>) {
      table.rounded_hidden_forward = rounded_hidden_forward;
      table.rounded_hidden_backward = rounded_hidden_backward;
    }
    return table;
  }();
  return kernels;
}

template const HeadKernels<float>& cpu_head_kernels<float>();
template const HeadKernels<double>& cpu_head_kernels<double>();

template <class Real>
OneLayerHead<Real>::OneLayerHead(const HeadShape& shape, const HeadKernels<Real>& kernels)
    : shape_(shape), kernels_(&kernels) {
  const Init hidden_init = Init::uniform(1 / std::sqrt(static_cast<double>(shape.feature)));
  const Init output_init = Init::uniform(1 / std::sqrt(static_cast<double>(shape.hidden)));
  specs_.push_back({"hidden/weight", shape.feature, shape.hidden, hidden_init, TensorRole::dense});
  specs_.push_back({"hidden/bias", 1, shape.hidden, hidden_init, TensorRole::dense});
  specs_.push_back({shape.output + "/weight", shape.hidden, shape.width, output_init, TensorRole::dense});
  specs_.push_back({shape.output + "/bias", 1, shape.width, output_init, TensorRole::dense});
  if (kernels.derive == nullptr) return;
  shape_.hidden_weight = rearranged_weight(specs_, kHiddenWeight, 0, shape.feature, shape.precision);
  shape_.output_weight = rearranged_weight(specs_, kOutputWeight, 0, shape.hidden, Precision::fp32);
}

template class OneLayerHead<float>;
template class OneLayerHead<double>;

}  // namespace semfield
