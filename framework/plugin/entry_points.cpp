// Checked entry points of every encoder, sampler and field.
#include <algorithm>
#include <cstdint>

#include "core/error.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/quadrature.h"
#include "plugin/reference.h"
#include "plugin/sampler.h"

namespace semfield {

template <class Real>
void Encoder<Real>::forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                            View<Real> y) const {
  constexpr const char* kCall = "encoder.forward";
  const EncoderTraits shape = traits();
  view_checks::require(kCall, "x", x, x.rows, shape.in_dims, x.device);
  view_checks::require(kCall, "y", y, x.rows, shape.out_dims, x.device);
  if (x.rows > 0) do_forward(ctx, tensors, x, y);
}

template <class Real>
void Encoder<Real>::backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                             View<const Real> dy, View<Real> dx) const {
  constexpr const char* kCall = "encoder.backward";
  const EncoderTraits shape = traits();
  view_checks::require(kCall, "x", x, x.rows, shape.in_dims, x.device);
  view_checks::require(kCall, "dy", dy, x.rows, shape.out_dims, x.device);
  view_checks::require_or_empty(kCall, "dx", dx, x.rows, shape.in_dims, x.device);
  const bool dx_alone = tensors.grad.empty() && !dx.empty();
  if (!dx_alone && tensors.grad.size() != tensors.value.size())
    view_checks::fail(kCall, "the tensors have no gradients");
  if (x.rows > 0) do_backward(ctx, tensors, x, dy, dx);
}

template class Encoder<float>;
template class Encoder<double>;

void bad_ray_limits(std::int64_t ray, double near_m, double far_m) {
  throw Error(ErrorKind::data, "scene.rays.limits",
              "ray " + std::to_string(ray) + " runs from " + std::to_string(near_m) + " to " + std::to_string(far_m) +
                  " m; samples need finite limits",
              "set a finite far distance");
}

namespace {

template <class Real>
std::int64_t most_samples_a_ray(const Samples<Real>& samples, std::int64_t rays) {
  std::int64_t most = 0;
  for (std::int64_t r = 0; r < rays; ++r) {
    most = std::max<std::int64_t>(most, samples.first(r + 1, 0) - samples.first(r, 0));
  }
  return most;
}

}  // namespace

template <class Real>
void Sampler<Real>::sample(const StepContext& ctx, const Tensors<Real>& tensors, const Rays<Real>& rays,
                           const Proposal<Real>* previous, Samples<Real>& out) const {
  constexpr const char* kCall = "sampler.sample";
  const std::int64_t count = rays.origin.rows;
  const Device device = rays.origin.device;
  view_checks::require(kCall, "origin", rays.origin, count, 3, device);
  view_checks::require(kCall, "direction", rays.direction, count, 3, device);
  view_checks::require(kCall, "near_far", rays.near_far, count, 2, device);
  view_checks::require_room(kCall, "first", out.first, count + 1, 1, device);
  out.count = 0;
  if (count == 0) {
    if (device == Device::cpu) out.first(0, 0) = 0;
    return;
  }
  std::int64_t previous_per_ray = 0;
  if (previous != nullptr) {
    if (previous->samples == nullptr) view_checks::fail(kCall, "previous has no samples");
    view_checks::require_room(kCall, "previous.first", previous->samples->first, count + 1, 1, device);
    view_checks::require_room(kCall, "previous.t", previous->samples->t, previous->samples->count, 1, device);
    view_checks::require_room(kCall, "previous.weight", previous->weight, previous->samples->count, 1, device);
    // On a device the number of samples in use is not known here: the rows of all rays are.
    previous_per_ray =
        device == Device::cpu ? most_samples_a_ray(*previous->samples, count) : previous->samples->count / count;
  } else if (traits().needs_previous) {
    view_checks::fail(kCall, "this sampler needs the samples of an earlier pass");
  }
  std::int64_t room = capacity(count, previous_per_ray, ctx.training);
  if (device != Device::cpu && traits().keeps_to_room) room = std::min(room, out.t.rows);
  view_checks::require_room(kCall, "t", out.t, room, 1, device);
  view_checks::require_room(kCall, "delta", out.delta, room, 1, device);
  view_checks::require_room(kCall, "ray_of_sample", out.ray_of_sample, room, 1, device);
  do_sample(ctx, tensors, rays, previous, out);
  if (out.count < 0 || out.count > room) {
    view_checks::fail(
        kCall, "wrote " + std::to_string(out.count) + " samples, more than its capacity of " + std::to_string(room));
  }
}

template class Sampler<float>;
template class Sampler<double>;

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
