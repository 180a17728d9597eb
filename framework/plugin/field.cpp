// Checked entry points of every field.
#include "plugin/field.h"

#include <cstdint>

#include "plugin/reference.h"

namespace semfield {

namespace {

constexpr std::uintptr_t kSavedAlignment = 64;

template <class Real>
void check_inputs(const char* call, const FieldTraits& traits, const FieldIn<Real>& in, bool wants_rgb) {
  const std::int64_t samples = in.position.rows;
  const Device device = in.position.device;
  view_checks::require(call, "position", in.position, samples, in.position.cols, device);
  view_checks::require_or_empty(call, "ray_of_sample", in.ray_of_sample, samples, 1, device);
  if (!in.direction.empty()) {
    view_checks::require_layout(call, "direction", in.direction, device);
    view_checks::require(call, "ray_of_sample", in.ray_of_sample, samples, 1, device);
  } else if (traits.uses_direction && wants_rgb && samples > 0) {
    view_checks::fail(call, "colour is wanted and direction is empty");
  }
}

template <class Real>
void check_outputs(const char* call, const FieldTraits& traits, const FieldIn<Real>& in, const FieldOut<Real>& out) {
  const std::int64_t samples = in.position.rows;
  const Device device = in.position.device;
  view_checks::require_or_empty(call, "sigma", out.sigma, samples, 1, device);
  view_checks::require_or_empty(call, "rgb", out.rgb, samples, 3, device);
  view_checks::require_or_empty(call, "feature", out.feature, samples, traits.feature_dims, device);
}

// The feature goes out in one form, and only in one that the field has.
template <class Real>
void check_form(const char* call, const Field<Real>& field, const FieldIn<Real>& in, const FieldOut<Real>& out) {
  const std::int32_t dims = field.traits().feature_dims;
  view_checks::require_or_empty(call, "fused.feature", out.fused.feature, in.position.rows, dims, in.position.device);
  const int forms =
      (out.feature.empty() ? 0 : 1) + (out.fused.feature.empty() ? 0 : 1) + (out.fused.hidden.empty() ? 0 : 1);
  if (forms > 1) view_checks::fail(call, "the feature is wanted in more than one form");
  if (!out.fused.feature.empty() && field.feature_form(0) == FeatureForm::full)
    view_checks::fail(call, "fused.feature is wanted of a field that has no such form");
  if (out.fused.hidden.empty()) return;
  if (field.feature_form(out.fused.hidden.cols) != FeatureForm::hidden_layer)
    view_checks::fail(call, "hidden is wanted of a field that does not compute such a layer");
  view_checks::require(call, "layer.weight", out.fused.layer.weight, dims, out.fused.hidden.cols, in.position.device);
  view_checks::require(call, "layer.bias", out.fused.layer.bias, 1, out.fused.hidden.cols, in.position.device);
  if (out.fused.hidden.rows > in.position.rows) view_checks::fail(call, "hidden has more rows than there are samples");
}

void check_saved(const char* call, Saved saved, std::size_t bytes) {
  if (saved.size() < bytes) {
    view_checks::fail(call, "saved has " + std::to_string(saved.size()) + " bytes, expected " + std::to_string(bytes));
  }
  if (reinterpret_cast<std::uintptr_t>(saved.data()) % kSavedAlignment != 0) {
    view_checks::fail(call, "saved is not aligned to 64 bytes");
  }
}

}  // namespace

template <class Real>
std::int64_t Field<Real>::multiply_adds(std::int64_t samples, std::int64_t rays) const {
  std::int64_t sum = 0;
  for (const LayerShape& layer : layers()) sum += layer.multiply_adds(samples, rays);
  return sum;
}

template <class Real>
void Field<Real>::forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                          const FieldOut<Real>& out, Saved saved) const {
  constexpr const char* kCall = "field.forward";
  const FieldTraits shape = traits();
  check_inputs(kCall, shape, in, !out.rgb.empty());
  check_outputs(kCall, shape, in, out);
  check_form(kCall, *this, in, out);
  if (in.position.rows == 0) return;
  if (!saved.empty()) check_saved(kCall, saved, saved_bytes(in.position.rows, in.direction.rows));
  do_forward(ctx, tensors, in, out, saved);
}

template <class Real>
void Field<Real>::backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                           const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                           View<Real> d_position) const {
  constexpr const char* kCall = "field.backward";
  const FieldTraits shape = traits();
  const std::int64_t samples = in.position.rows;
  const Device device = in.position.device;
  check_inputs(kCall, shape, in, !grad.rgb.empty());
  check_outputs(kCall, shape, in, out);
  if ((!grad.fused.feature.empty() && feature_form(0) == FeatureForm::full) ||
      (grad.fused.hidden != nullptr && feature_form(out.fused.hidden.cols) != FeatureForm::hidden_layer))
    view_checks::fail(kCall, "the feature's gradient comes in a form that the field does not have");
  view_checks::require_or_empty(kCall, "grad.sigma", grad.sigma, samples, 1, device);
  view_checks::require_or_empty(kCall, "grad.rgb", grad.rgb, samples, 3, device);
  view_checks::require_or_empty(kCall, "grad.feature", grad.feature, samples, shape.feature_dims, device);
  view_checks::require_or_empty(kCall, "d_position", d_position, samples, in.position.cols, device);
  if (tensors.grad.size() != tensors.value.size()) view_checks::fail(kCall, "the tensors have no gradients");
  if (samples == 0) return;
  check_saved(kCall, saved, saved_bytes(samples, in.direction.rows));
  do_backward(ctx, tensors, in, out, grad, saved, d_position);
}

template class Field<float>;
template class Field<double>;

}  // namespace semfield
