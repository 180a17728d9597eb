// Guarded matrices, and benches: a component under test with its tensors, inputs and guarded outputs.
#pragma once

#include <bit>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "core/rng.h"
#include "core/view.h"
#include "core/workspace.h"
#include "plugin/field.h"
#include "testkit/compare.h"
#include "testkit/laws.h"

namespace semfield::testkit {

/// [rows, cols] matrix with `padding` columns between rows and guard elements before and after. Every element starts as
/// poison: for floating types a NaN with a payload that no computation gives; 0x5A bytes for integers.
template <class T>
class Guarded {
 public:
  Guarded(std::int64_t rows, std::int32_t cols, std::int32_t padding = 0)
      : rows_(rows),
        cols_(cols),
        padding_(padding),
        data_(static_cast<std::size_t>(2 * kGuard + rows * (cols + padding)), poison()) {}

  View<T> view() { return View<T>(data_.data() + kGuard, rows_, cols_, cols_ + padding_); }
  View<const T> view() const { return View<const T>(data_.data() + kGuard, rows_, cols_, cols_ + padding_); }
  T& operator()(std::int64_t r, std::int32_t c) { return view()(r, c); }
  const T& operator()(std::int64_t r, std::int32_t c) const { return view()(r, c); }
  void fill(T value) {
    for (std::int64_t r = 0; r < rows_; ++r) {
      for (std::int32_t c = 0; c < cols_; ++c) (*this)(r, c) = value;
    }
  }
  std::int64_t rows() const { return rows_; }
  std::int32_t cols() const { return cols_; }

  /// "" when guards and padding are untouched, else a sentence that names the place.
  std::string broken_guard() const {
    const std::int64_t stride = cols_ + padding_;
    for (std::size_t i = 0; i < data_.size(); ++i) {
      const std::int64_t offset = static_cast<std::int64_t>(i) - kGuard;
      const bool inside = offset >= 0 && offset < rows_ * stride;
      if ((inside && offset % stride < cols_) || is_poison(data_[i])) continue;
      if (offset < 0) return "wrote " + std::to_string(-offset) + " elements before the buffer";
      return inside ? "wrote into the padding of row " + std::to_string(offset / stride)
                    : "wrote " + std::to_string(offset - rows_ * stride) + " elements past the buffer";
    }
    return {};
  }
  /// "" when the first `rows` rows hold no poison (for floating types: no NaN), else the first unwritten element.
  std::string unwritten(std::int64_t rows) const {
    for (std::int64_t r = 0; r < rows; ++r) {
      for (std::int32_t c = 0; c < cols_; ++c) {
        const T value = (*this)(r, c);
        if (is_poison(value)) return shown_place(r, c) + " was not written";
        if (value != value) return shown_place(r, c) + " is NaN";
      }
    }
    return {};
  }
  std::string unwritten() const { return unwritten(rows_); }

 private:
  static constexpr std::int64_t kGuard = 64;
  static T poison() {
    T value;
    std::memset(&value, 0x5A, sizeof(value));
    if constexpr (std::is_same_v<T, float>) value = std::bit_cast<float>(0x7FC5A5A5u);
    if constexpr (std::is_same_v<T, double>) value = std::bit_cast<double>(std::uint64_t{0x7FF8A5A5A5A5A5A5u});
    return value;
  }
  static bool is_poison(const T& value) {
    const T expected = poison();
    return std::memcmp(&value, &expected, sizeof(T)) == 0;
  }
  std::int64_t rows_;
  std::int32_t cols_;
  std::int32_t padding_;
  std::vector<T> data_;
};

/// Uniform in [-1, 1) in fp32, addressed by (seed, name, element), so that float and double hold the same numbers.
template <class Real>
void fill_uniform(View<Real> view, std::string_view name, std::uint64_t seed) {
  const RandomAddress address{seed, 0, stream_id(name)};
  for (std::int64_t r = 0; r < view.rows; ++r) {
    for (std::int32_t c = 0; c < view.cols; ++c)
      view(r, c) = static_cast<Real>(2 * uniform01(address, static_cast<std::uint64_t>(r * view.cols + c)) - 1);
  }
}

/// sum(weight * value), in double.
template <class Real>
double weighted_sum(const Guarded<Real>& weight, const Guarded<Real>& value) {
  double sum = 0;
  for (std::int64_t r = 0; r < value.rows(); ++r) {
    for (std::int32_t c = 0; c < value.cols(); ++c)
      sum += static_cast<double>(weight(r, c)) * static_cast<double>(value(r, c));
  }
  return sum;
}

/// What a call writes, by its name in messages.
template <class Real>
struct Written {
  const char* name;
  Guarded<Real>* rows;
};

/// An input of a bench, and its gradient.
struct BenchInput {
  const char* name;
  View<double> value;
  View<const double> gradient;
};

/// What benches of every kind have: the component, its tensors and a workspace.
template <class Real, template <class> class Kind>
struct ComponentBench {
  ComponentBench(const Kind<Real>& of, const LawOptions& options, double noise = 0.1)
      : component(of), workspace(scratch_of<Real>(options)), box(of, options.seed, noise) {
    ctx.seed = options.seed;
    ctx.training = true;
    ctx.workspace = &workspace;
  }
  void derive() { component.derive(ctx, box.tensors()); }

  const Kind<Real>& component;
  Workspace workspace;
  StepContext ctx;
  TensorBox<Real> box;
};

/// Which outputs forward fills.
struct Wanted {
  bool sigma = true, rgb = true, feature = true;
};

template <class Real>
struct FieldBench : ComponentBench<Real, Field> {
  /// Rays of kSamplesPerRay samples; ray 1 has none, as rays of ragged batches have.
  static constexpr std::int64_t kSamplesPerRay = 5;

  FieldBench(const Field<Real>& field, const FieldBuild& build, std::int64_t samples, std::int32_t padding,
             const LawOptions& options)
      : ComponentBench<Real, Field>(field, options),
        shape(field.traits()),
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
    fill_uniform(position.view(), "testkit/position", options.seed);
    fill_uniform(direction.view(), "testkit/direction", options.seed);
    fill_uniform(w_sigma.view(), "testkit/w_sigma", options.seed);
    fill_uniform(w_rgb.view(), "testkit/w_rgb", options.seed);
    fill_uniform(w_feature.view(), "testkit/w_feature", options.seed);
    for (std::int64_t m = 0; m < samples; ++m) {
      const std::int64_t ray = m / kSamplesPerRay;
      ray_of_sample(m, 0) = static_cast<std::int32_t>(ray < 1 ? ray : ray + 1);
    }
    saved_memory_.resize(field.saved_bytes(samples, in().direction.rows) + kSavedAlignment, std::byte{0x5A});
    this->derive();
  }

  FieldIn<Real> in() const {
    FieldIn<Real> inputs;
    inputs.position = position.view();
    if (direction.cols() > 0) inputs.direction = direction.view();
    inputs.ray_of_sample = ray_of_sample.view();
    return inputs;
  }
  FieldOut<Real> out(Wanted wanted = {}) {
    FieldOut<Real> outputs;
    if (wanted.sigma) outputs.sigma = sigma.view();
    if (wanted.rgb) outputs.rgb = rgb.view();
    if (wanted.feature && shape.feature_dims > 0) outputs.feature = feature.view();
    return outputs;
  }
  /// Fixed random weights of the outputs: dL/d(outputs) of L = sum(weight * output).
  FieldGrad<Real> output_weights(Wanted wanted = {}) const {
    FieldGrad<Real> weights;
    if (wanted.sigma) weights.sigma = w_sigma.view();
    if (wanted.rgb) weights.rgb = w_rgb.view();
    if (wanted.feature && shape.feature_dims > 0) weights.feature = w_feature.view();
    return weights;
  }
  Saved saved() {
    const auto address = reinterpret_cast<std::uintptr_t>(saved_memory_.data());
    const std::size_t skip = (kSavedAlignment - address % kSavedAlignment) % kSavedAlignment;
    return Saved(saved_memory_).subspan(skip, saved_memory_.size() - kSavedAlignment);
  }
  void forward(Wanted wanted = {}) {
    this->component.forward(this->ctx, this->box.tensors(), in(), out(wanted), saved());
  }
  void backward(Wanted wanted = {}, bool with_d_position = true) {
    this->component.backward(this->ctx, this->box.tensors(), in(), out(), output_weights(wanted), saved(),
                             with_d_position ? d_position.view() : View<Real>());
    this->component.derive_backward(this->ctx, this->box.tensors());
  }
  /// Both for some of the samples.
  void part(std::int64_t begin, std::int64_t count) {
    const auto cut = [&](auto view) { return view.empty() ? view : view.row_range(begin, count); };
    const FieldOut<Real> all = out();
    const FieldGrad<Real> weights = output_weights();
    const FieldIn<Real> part_in{cut(in().position), in().direction, cut(in().ray_of_sample)};
    const FieldOut<Real> part_out{cut(all.sigma), cut(all.rgb), cut(all.feature)};
    const FieldGrad<Real> part_weights{cut(weights.sigma), cut(weights.rgb), cut(weights.feature)};
    this->component.forward(this->ctx, this->box.tensors(), part_in, part_out, saved());
    this->component.backward(this->ctx, this->box.tensors(), part_in, part_out, part_weights, saved(),
                             cut(d_position.view()));
  }
  /// L after forward.
  double loss() const {
    return weighted_sum(w_sigma, sigma) + weighted_sum(w_rgb, rgb) +
           (shape.feature_dims > 0 ? weighted_sum(w_feature, feature) : 0.0);
  }
  std::vector<Written<Real>> outputs() { return {{"sigma", &sigma}, {"colour", &rgb}, {"feature", &feature}}; }
  std::vector<Written<Real>> gradients() { return {{"d_position", &d_position}}; }
  std::vector<BenchInput> inputs() { return {{"position", position.view(), d_position.view()}}; }
  static constexpr const char* kRows = "samples";

  FieldTraits shape;
  Guarded<Real> position, direction;
  Guarded<std::int32_t> ray_of_sample;
  Guarded<Real> sigma, rgb, feature;
  Guarded<Real> w_sigma, w_rgb, w_feature;
  Guarded<Real> d_position;

 private:
  static constexpr std::size_t kSavedAlignment = 64;
  std::vector<std::byte> saved_memory_;
};

}  // namespace semfield::testkit
