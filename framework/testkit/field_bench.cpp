// Inputs and outputs of a field under test.
#include "testkit/field_bench.h"

#include "core/rng.h"

namespace semfield::testkit {

namespace {

constexpr std::int64_t kSamplesPerRay = 5;

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

template class FieldBench<float>;
template class FieldBench<double>;

// Poison, sentinels and their inspection.

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
