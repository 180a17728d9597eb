// Buffers that notice: unwritten elements stay NaN, writes outside or into the padding between rows are found.
#pragma once

#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "core/view.h"

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

}  // namespace semfield::testkit
