// What fields on a CPU do around their layers, whatever their activations are. For kernel files alone: everything
// here is private to the file and to its instruction set.
#pragma once

#include <algorithm>
#include <cstdint>
#include <type_traits>

#include "compute/isa.h"
#include "compute/layers.h"
#include "compute/math_functions.h"
#include "compute/row_loops.h"
#include "plugin/field.h"

namespace semfield::SEMFIELD_ISA {
namespace {

template <class Real>
View<const Real> value(const Tensors<Real>& t, int index) {
  return t.value[static_cast<std::size_t>(index)];
}
template <class Real>
View<Real> grad_of(const Tensors<Real>& t, int index) {
  return t.grad[static_cast<std::size_t>(index)];
}

/// Sums that a later layer starts from: in the result's own memory, or, where that is bf16, in `arena`.
template <class Activation>
View<SumOf<Activation>> sums_before(View<Activation> result, Workspace& arena) {
  if constexpr (std::is_same_v<Activation, Bf16>) {
    return arena.take<float>(result.rows, result.cols);
  } else {
    return result;
  }
}

/// [M, direction_dims]: each sample's direction.
template <class Real>
View<Real> gather_directions(const FieldIn<Real>& in, Workspace& arena) {
  const View<Real> gathered = arena.take<Real>(in.position.rows, in.direction.cols);
  for (std::int64_t m = 0; m < gathered.rows; ++m)
    std::copy_n(in.direction.row(in.ray_of_sample(m, 0)), gathered.cols, gathered.row(m));
  return gathered;
}

/// The logits of a colour to the colour.
template <class Real>
void color_of_logits(View<Real> rgb) {
  if (rgb.contiguous()) return sigmoid_inplace(rgb.data, rgb.size());
  for (std::int64_t m = 0; m < rgb.rows; ++m) sigmoid_inplace(rgb.row(m), rgb.cols);
}

/// dL/d(logits) [M, 3] of the colour.
template <class Real>
View<Real> logit_gradient(View<const Real> rgb, View<const Real> d_rgb, Workspace& arena) {
  const View<Real> d_logit = arena.take<Real>(rgb.rows, 3);
  for (std::int64_t m = 0; m < rgb.rows; ++m) {
    for (int c = 0; c < 3; ++c) d_logit(m, c) = d_rgb(m, c) * (rgb(m, c) * (Real(1) - rgb(m, c)));
  }
  return d_logit;
}

/// Whether the feature can go out in bf16 to a head with so many hidden numbers: rows without padding.
constexpr FeatureForm rounded_form(std::int32_t feature_dims, std::int32_t hidden_width) {
  return feature_dims % 32 == 0 && hidden_width % 32 == 0 ? FeatureForm::rounded : FeatureForm::full;
}

/// The feature in the form that is wanted.
template <class Activation, class Real>
void hand_on_feature(View<const Activation> feature, const FieldOut<Real>& out) {
  if constexpr (std::is_same_v<Activation, Bf16>) {
    if (!out.feature.empty()) widen_rows(feature, out.feature);
    for (std::int64_t m = 0; m < out.fused.feature.rows; ++m)
      std::copy_n(feature.row(m), feature.cols, out.fused.feature.row(m));
  } else if (!out.feature.empty()) {
    copy_rows(feature, out.feature);
  }
}

template <class Real>
bool has_feature_gradient(const FieldGrad<Real>& grad) {
  return !grad.feature.empty() || !grad.fused.feature.empty();
}

/// d_feature [M, F] from the form in which it came.
template <class Real>
void take_feature_gradient(const FieldGrad<Real>& grad, View<Real> d_feature) {
  if (!grad.feature.empty()) return copy_rows(grad.feature, d_feature);
  if constexpr (std::is_same_v<Real, float>) {
    const std::int64_t rows = grad.fused.feature.rows;
    widen_rows(grad.fused.feature, d_feature.row_range(0, rows));
    fill(d_feature.row_range(rows, d_feature.rows - rows), 0.0F);
  }
}

/// dz = after > 0 ? sums : 0 where no layer follows that could do it; `sums` may be dz itself.
template <class Activation>
void through_relu(View<const Activation> after, View<SumOf<Activation>> sums, View<Activation> dz) {
  if constexpr (std::is_same_v<Activation, Bf16>) {
    round_rows(sums, dz, after);
  } else {
    relu_backward<Activation>(after, dz);
  }
}

}  // namespace
}  // namespace semfield::SEMFIELD_ISA
