// One field with tensors, inputs and guarded outputs, as the field laws use it.
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
  void fill(T value);
  std::int64_t rows() const { return rows_; }
  std::int32_t cols() const { return cols_; }

  /// "" when guards and padding are untouched, else a sentence that names the place.
  std::string broken_guard() const;
  /// "" when the first `rows` rows hold no poison (for floating types: no NaN), else the first unwritten element.
  std::string unwritten(std::int64_t rows) const;
  std::string unwritten() const { return unwritten(rows_); }

 private:
  static constexpr std::int64_t kGuard = 64;
  bool is_padding(std::size_t index) const;
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

  FieldIn<Real> in() const;
  FieldOut<Real> out(Wanted wanted = {});
  /// Fixed random weights of the outputs: dL/d(outputs) of L = sum(weight * output).
  FieldGrad<Real> output_weights(Wanted wanted = {}) const;
  Saved saved();
  void derive() { field.derive(ctx, box.tensors()); }
  void forward(Wanted wanted = {}) { field.forward(ctx, box.tensors(), in(), out(wanted), saved()); }
  void backward(Wanted wanted = {}, bool with_d_position = true);
  /// L after derive and forward.
  double loss();

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
  std::vector<std::byte> saved_memory_;
};

extern template class FieldBench<float>;
extern template class FieldBench<double>;

}  // namespace semfield::testkit
