// Guarded matrices, a field under test, and what the laws of encoders, fields and heads share.
#pragma once

#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "core/view.h"
#include "plugin/field.h"
#include "testkit/compare.h"
#include "testkit/laws.h"

namespace semfield::testkit {

/// [rows, cols] matrix with `padding` columns between rows and guard elements before and after. Every element starts as
/// poison: NaN for floating types, 0x5A bytes for integers.
template <class T>
class Guarded {
 public:
  Guarded(std::int64_t rows, std::int32_t cols, std::int32_t padding = 0);

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
  std::string broken_guard() const;
  /// "" when the first `rows` rows hold no poison (for floating types: no NaN), else the first unwritten element.
  std::string unwritten(std::int64_t rows) const;
  std::string unwritten() const { return unwritten(rows_); }

 private:
  static constexpr std::int64_t kGuard = 64;
  bool is_padding(std::size_t index) const {
    const std::int64_t i = static_cast<std::int64_t>(index) - kGuard;
    const std::int64_t stride = cols_ + padding_;
    return i < 0 || i >= rows_ * stride || i % stride >= cols_;
  }
  std::int64_t rows_;
  std::int32_t cols_;
  std::int32_t padding_;
  std::vector<T> data_;
};

/// Uniform in [-1, 1) in fp32, addressed by (seed, name, element), so that float and double hold the same numbers.
template <class Real>
void fill_uniform(View<Real> view, std::string_view name, std::uint64_t seed);

extern template class Guarded<float>;
extern template class Guarded<double>;
extern template class Guarded<std::int32_t>;

/// Which outputs forward fills.
struct Wanted {
  bool sigma = true, rgb = true, feature = true;
};

template <class Real>
class FieldBench {
 public:
  FieldBench(const Field<Real>& field, const FieldBuild& build, std::int64_t samples, std::int32_t padding,
             const LawOptions& options);

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
  void derive() { field.derive(ctx, box.tensors()); }
  void forward(Wanted wanted = {}) { field.forward(ctx, box.tensors(), in(), out(wanted), saved()); }
  void backward(Wanted wanted = {}, bool with_d_position = true) {
    field.backward(ctx, box.tensors(), in(), out(), output_weights(wanted), saved(),
                   with_d_position ? d_position.view() : View<Real>());
    field.derive_backward(ctx, box.tensors());
  }
  void step() { forward(), backward(); }
  /// L after derive and forward.
  double loss() {
    derive();
    forward();
    double sum = weighted_sum(w_sigma, sigma) + weighted_sum(w_rgb, rgb);
    if (shape.feature_dims > 0) sum += weighted_sum(w_feature, feature);
    return sum;
  }

  const Field<Real>& field;
  FieldTraits shape;
  Workspace workspace;
  StepContext ctx;
  TensorBox<Real> box;
  Guarded<Real> position, direction;
  Guarded<std::int32_t> ray_of_sample;
  Guarded<Real> sigma, rgb, feature;
  Guarded<Real> w_sigma, w_rgb, w_feature;
  Guarded<Real> d_position;

 private:
  static constexpr std::size_t kSavedAlignment = 64;
  std::vector<std::byte> saved_memory_;
};

extern template class FieldBench<float>;
extern template class FieldBench<double>;

// What the laws of encoders, fields and heads share. A bench has tensors in `box`, a `workspace`, forward(),
// backward(), step(), which is both, and loss(), the scalar whose gradients backward gives.

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

/// same(got, want) of the gradients of every learned tensor; a sentence is noted as "<law><name>: ...".
template <class A, class B, class Same>
void compare_learned(Failures& failures, const std::string& law, const TensorBox<A>& got, const TensorBox<B>& want,
                     const Same& same) {
  for (std::size_t i = 0; i < want.count(); ++i) {
    if (want.learned(i))
      note_failure(failures, law + want.specs()[i].name, same(View<const A>(got.grad(i)), View<const B>(want.grad(i))));
  }
}

/// Comparison of gradients that are sums over rows (LawOptions::same_bits_of_sums).
template <class Real>
auto same_sums(const LawOptions& options) {
  return [&options](View<const Real> got, View<const Real> want) {
    return options.same_bits_of_sums ? compare_bits(got, want) : compare(got, want, options.float_tolerance);
  };
}

/// An input of a bench, and its gradient.
struct BenchInput {
  const char* name;
  View<double> value;
  View<const double> gradient;
};

/// Gradients of inputs and of every learned tensor against central differences.
template <class Bench>
void check_gradients(Bench& bench, const LawOptions& options, std::initializer_list<BenchInput> inputs,
                     Failures& failures) {
  bench.step();
  const GradientCheck check{options.gradient_tolerance, 1e-6, options.gradient_elements, options.seed};
  const auto loss = [&bench] { return bench.loss(); };
  for (const BenchInput& input : inputs)
    note_failure(failures, std::string("gradient of ") + input.name,
                 check_gradient(loss, input.value, input.gradient, check));
  for (std::size_t i = 0; i < bench.box.count(); ++i) {
    if (!bench.box.learned(i)) continue;
    note_failure(failures, "gradient of " + bench.box.specs()[i].name,
                 check_gradient(loss, bench.box.value(i), bench.box.grad(i), check));
  }
}

template <class Bench>
void check_steady_state(Bench& bench, Failures& failures) {
  for (int warm_up = 0; warm_up < 2; ++warm_up) bench.step();
  const std::int64_t growths = bench.workspace.growth_count();
  bench.step();
  if (bench.workspace.growth_count() != growths)
    failures.push_back("steady state: the workspace still grows in the third step; is a Workspace::Scope missing?");
}

}  // namespace semfield::testkit
