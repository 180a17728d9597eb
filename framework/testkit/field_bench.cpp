// Inputs and outputs of a field under test.
#include "testkit/field_bench.h"

namespace semfield::testkit {

namespace {

constexpr std::size_t kSavedAlignment = 64;
constexpr std::int64_t kSamplesPerRay = 5;

template <class Real>
double weighted_sum(View<const Real> weight, View<const Real> value) {
  double sum = 0;
  for (std::int64_t r = 0; r < value.rows; ++r) {
    for (std::int32_t c = 0; c < value.cols; ++c)
      sum += static_cast<double>(weight(r, c)) * static_cast<double>(value(r, c));
  }
  return sum;
}

}  // namespace

template <class Real>
FieldBench<Real>::FieldBench(const Field<Real>& field_in, const FieldBuild& build, std::int64_t samples,
                             std::int32_t padding, const LawOptions& options)
    : field(field_in),
      shape(field_in.traits()),
      workspace(scratch_of<Real>(options)),
      box(field_in, options.seed),
      position(samples, build.position_dims, padding),
      direction(samples / kSamplesPerRay + 2, build.direction_dims, padding),
      ray_of_sample(samples, 1, padding),
      sigma(samples, 1, padding),
      rgb(samples, 3, padding),
      feature(samples, shape.feature_dims, padding),
      w_sigma(samples, 1, padding),
      w_rgb(samples, 3, padding),
      w_feature(samples, shape.feature_dims, padding),
      d_position(samples, build.position_dims, padding) {
  ctx.seed = options.seed;
  ctx.training = true;
  ctx.workspace = &workspace;
  fill_uniform(position.view(), "testkit/position", options.seed);
  fill_uniform(direction.view(), "testkit/direction", options.seed);
  fill_uniform(w_sigma.view(), "testkit/w_sigma", options.seed);
  fill_uniform(w_rgb.view(), "testkit/w_rgb", options.seed);
  fill_uniform(w_feature.view(), "testkit/w_feature", options.seed);
  // Ray 1 has no samples: ragged batches have such rays.
  for (std::int64_t m = 0; m < samples; ++m) {
    const std::int64_t ray = m / kSamplesPerRay;
    ray_of_sample(m, 0) = static_cast<std::int32_t>(ray < 1 ? ray : ray + 1);
  }
  saved_memory_.resize(field.saved_bytes(samples, in().direction.rows) + kSavedAlignment, std::byte{0x5A});
  derive();
}

template <class Real>
FieldIn<Real> FieldBench<Real>::in() const {
  FieldIn<Real> inputs;
  inputs.position = position.view();
  if (direction.cols() > 0) inputs.direction = direction.view();
  inputs.ray_of_sample = ray_of_sample.view();
  return inputs;
}

template <class Real>
FieldOut<Real> FieldBench<Real>::out(Wanted wanted) {
  FieldOut<Real> outputs;
  if (wanted.sigma) outputs.sigma = sigma.view();
  if (wanted.rgb) outputs.rgb = rgb.view();
  if (wanted.feature && shape.feature_dims > 0) outputs.feature = feature.view();
  return outputs;
}

template <class Real>
FieldGrad<Real> FieldBench<Real>::output_weights(Wanted wanted) const {
  FieldGrad<Real> weights;
  if (wanted.sigma) weights.sigma = w_sigma.view();
  if (wanted.rgb) weights.rgb = w_rgb.view();
  if (wanted.feature && shape.feature_dims > 0) weights.feature = w_feature.view();
  return weights;
}

template <class Real>
Saved FieldBench<Real>::saved() {
  const auto address = reinterpret_cast<std::uintptr_t>(saved_memory_.data());
  const std::size_t skip = (kSavedAlignment - address % kSavedAlignment) % kSavedAlignment;
  return Saved(saved_memory_).subspan(skip, saved_memory_.size() - kSavedAlignment);
}

template <class Real>
void FieldBench<Real>::backward(Wanted wanted, bool with_d_position) {
  field.backward(ctx, box.tensors(), in(), out(), output_weights(wanted), saved(),
                 with_d_position ? d_position.view() : View<Real>());
  field.derive_backward(ctx, box.tensors());
}

template <class Real>
double FieldBench<Real>::loss() {
  derive();
  forward();
  double sum = weighted_sum<Real>(w_sigma.view(), sigma.view()) + weighted_sum<Real>(w_rgb.view(), rgb.view());
  if (shape.feature_dims > 0) sum += weighted_sum<Real>(w_feature.view(), feature.view());
  return sum;
}

template class FieldBench<float>;
template class FieldBench<double>;

}  // namespace semfield::testkit
