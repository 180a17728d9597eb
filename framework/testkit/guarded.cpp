// Poison, sentinels and their inspection.
#include "testkit/guarded.h"

#include "core/rng.h"

namespace semfield::testkit {

namespace {

// A NaN with a payload, so that a computed NaN written into a guard is also told apart from the guard itself.
template <class T>
T poison() {
  T value;
  if constexpr (std::is_same_v<T, float>) {
    const std::uint32_t bits = 0x7FC5A5A5u;
    std::memcpy(&value, &bits, sizeof(value));
  } else if constexpr (std::is_same_v<T, double>) {
    const std::uint64_t bits = 0x7FF8A5A5A5A5A5A5u;
    std::memcpy(&value, &bits, sizeof(value));
  } else {
    std::memset(&value, 0x5A, sizeof(value));
  }
  return value;
}

template <class T>
bool is_poison(const T& value) {
  const T expected = poison<T>();
  return std::memcmp(&value, &expected, sizeof(T)) == 0;
}

}  // namespace

template <class T>
Guarded<T>::Guarded(std::int64_t rows, std::int32_t cols, std::int32_t padding)
    : rows_(rows),
      cols_(cols),
      padding_(padding),
      data_(static_cast<std::size_t>(2 * kGuard + rows * (cols + padding)), poison<T>()) {}

template <class T>
void Guarded<T>::fill(T value) {
  for (std::int64_t r = 0; r < rows_; ++r) {
    for (std::int32_t c = 0; c < cols_; ++c) (*this)(r, c) = value;
  }
}

template <class T>
bool Guarded<T>::is_padding(std::size_t index) const {
  const std::int64_t i = static_cast<std::int64_t>(index) - kGuard;
  const std::int64_t stride = cols_ + padding_;
  return i < 0 || i >= rows_ * stride || i % stride >= cols_;
}

template <class T>
std::string Guarded<T>::broken_guard() const {
  for (std::size_t i = 0; i < data_.size(); ++i) {
    if (!is_padding(i) || is_poison(data_[i])) continue;
    const std::int64_t offset = static_cast<std::int64_t>(i) - kGuard;
    if (offset < 0) return "wrote " + std::to_string(-offset) + " elements before the buffer";
    const std::int64_t stride = cols_ + padding_;
    if (offset >= rows_ * stride)
      return "wrote " + std::to_string(offset - rows_ * stride) + " elements past the buffer";
    return "wrote into the padding of row " + std::to_string(offset / stride);
  }
  return {};
}

template <class T>
std::string Guarded<T>::unwritten(std::int64_t rows) const {
  for (std::int64_t r = 0; r < rows; ++r) {
    for (std::int32_t c = 0; c < cols_; ++c) {
      const T value = (*this)(r, c);
      if (is_poison(value)) return "element (" + std::to_string(r) + ", " + std::to_string(c) + ") was not written";
      if (value != value) return "element (" + std::to_string(r) + ", " + std::to_string(c) + ") is NaN";
    }
  }
  return {};
}

template <class Real>
void fill_uniform(View<Real> view, std::string_view name, std::uint64_t seed) {
  const RandomAddress address{seed, 0, stream_id(name)};
  for (std::int64_t r = 0; r < view.rows; ++r) {
    for (std::int32_t c = 0; c < view.cols; ++c)
      view(r, c) = static_cast<Real>(2 * uniform01(address, static_cast<std::uint64_t>(r * view.cols + c)) - 1);
  }
}

template void fill_uniform<float>(View<float>, std::string_view, std::uint64_t);
template void fill_uniform<double>(View<double>, std::string_view, std::uint64_t);
template class Guarded<float>;
template class Guarded<double>;
template class Guarded<std::int32_t>;

}  // namespace semfield::testkit
