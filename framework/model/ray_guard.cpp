#include "model/ray_guard.h"

#include <fmt/format.h>

#include <cmath>
#include <limits>

#include "compute/math_functions.h"

namespace semfield {

namespace {

// Row of the first value that is not finite, or -1.
template <class T>
std::int64_t first_bad_row(View<const T> values) {
  if (values.empty() || values.rows == 0) return -1;
  if (values.contiguous() && all_finite(values.data, values.size())) return -1;
  for (std::int64_t r = 0; r < values.rows; ++r) {
    if (!all_finite(values.row(r), values.cols)) return r;
  }
  return -1;
}

// "is nan", or "is nan in column 4" for several columns.
template <class T>
std::string first_in_row(const T* row, std::int32_t cols) {
  std::int32_t c = 0;
  while (c + 1 < cols && std::isfinite(row[c])) ++c;
  return cols > 1 ? fmt::format("is {:.6g} in column {}", row[c], c) : fmt::format("is {:.6g}", row[c]);
}

}  // namespace

RayFault::RayFault(std::int64_t ray, ErrorKind kind, Code code, std::string message, std::string remedy)
    : Error(kind, code, std::move(message), std::move(remedy)), ray_(ray) {}

std::string_view fault_remedy() {
  return "lower train.adam.learning_rate, or resume from the last checkpoint with another runtime.seed";
}

template <class Real>
void guard_rays(const Rays<Real>& rays, View<const float> target, std::int64_t first_ray) {
  const auto check = [&](const char* name, const auto& values) {
    const std::int64_t bad = first_bad_row(values);
    if (bad < 0) return;
    throw RayFault(first_ray + bad, ErrorKind::failure, "scene.rays.invalid",
                   fmt::format("{} of ray {} {}", name, first_ray + bad, first_in_row(values.row(bad), values.cols)),
                   "check the camera poses, the intrinsics and the near and far distances of the scene");
  };
  check("origin", rays.origin);
  check("direction", rays.direction);
  check("near and far distance", rays.near_far);
  check("true colour", target);
}

template <class Real>
void RayGuard<Real>::fail(const char* name, std::int64_t row, const std::string& what) const {
  const std::int64_t r = samples_.ray_of_sample(row, 0);
  std::string place = fmt::format("ray {}", first_ray_ + r);
  if (!samples_.t.empty()) {
    place += fmt::format(", sample {}", row - samples_.first(r, 0));
    if (std::isfinite(samples_.t(row, 0))) place += fmt::format(" at {:.4g} m", samples_.t(row, 0));
  }
  throw RayFault(first_ray_ + r, ErrorKind::failure, "train.value.not_finite",
                 fmt::format("pass '{}': {} of {} {}", pass_, name, place, what), std::string(fault_remedy()));
}

template <class Real>
void RayGuard<Real>::samples(View<const double> x) const {
  constexpr Real kLargest = std::numeric_limits<Real>::max();
  const auto bad_interval = [](Real delta) { return !(delta >= 0) || !(delta <= kLargest); };
  int bad = 0;
  for (std::int64_t m = 0; m < samples_.count; ++m)
    bad |= !(std::abs(samples_.t.data[m]) <= kLargest) || bad_interval(samples_.delta.data[m]) ? 1 : 0;
  for (std::int64_t m = 0; m < samples_.count && bad != 0; ++m) {
    const Real t = samples_.t.data[m], delta = samples_.delta.data[m];
    if (!std::isfinite(t)) fail("distance", m, fmt::format("is {}", t));
    if (bad_interval(delta)) fail("interval", m, fmt::format("is {}; it must be finite and not negative", delta));
  }
  const std::int64_t row = first_bad_row(x);
  if (row >= 0) fail("position", row, first_in_row(x.row(row), x.cols));
}

template <class Real>
void RayGuard<Real>::per_sample(const char* name, View<const Real> values) const {
  const std::int64_t row = first_bad_row(values);
  if (row >= 0) fail(name, row, first_in_row(values.row(row), values.cols));
}

template <class Real>
void RayGuard<Real>::per_ray(const char* name, View<const Real> values) const {
  const std::int64_t row = first_bad_row(values);
  if (row < 0) return;
  throw RayFault(first_ray_ + row, ErrorKind::failure, "train.value.not_finite",
                 fmt::format("pass '{}': {} of ray {} {}", pass_, name, first_ray_ + row,
                             first_in_row(values.row(row), values.cols)),
                 std::string(fault_remedy()));
}

#define SEMFIELD_INSTANTIATE(Real) \
  template class RayGuard<Real>;   \
  template void guard_rays<Real>(const Rays<Real>&, View<const float>, std::int64_t);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
