// Values of rays that no later stage may see: found at the stage that made them, named by pass, ray and sample.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "core/error.h"
#include "plugin/sampler.h"

namespace semfield {

/// An error that belongs to one ray. Who knows the rays' pixels adds frame and pixel.
class RayFault : public Error {
 public:
  /// `ray` counts within the batch of a step, or within the call that rendered.
  RayFault(std::int64_t ray, ErrorKind kind, Code code, std::string message, std::string remedy = {});
  std::int64_t ray() const noexcept { return ray_; }

 private:
  std::int64_t ray_;
};

/// The remedy of a value that left the numbers during training.
std::string_view fault_remedy();

/// Rays of a call as they come in: origin, direction and limits of each must be finite, and colours where they are
/// given ([R, 3], else empty). Throws RayFault; first_ray is added to its number.
template <class Real>
void guard_rays(const Rays<Real>& rays, View<const float> target, std::int64_t first_ray);

/// The checks of one tile of one pass. Every value is looked at, as whole arrays: a tile costs a reading of what is in
/// cache. All throw RayFault for the first bad value.
template <class Real>
class RayGuard {
 public:
  /// Borrows all of them. `samples` may lack t (rounds of rendering): then a message names the ray alone.
  RayGuard(std::string_view pass, std::int64_t first_ray, const Samples<Real>& samples)
      : pass_(pass), first_ray_(first_ray), samples_(samples) {}

  /// Distances finite, intervals finite and not negative, coordinates x [M, 3] finite.
  void samples(View<const double> x) const;
  /// values [M, C], a row per sample, each finite.
  void per_sample(const char* name, View<const Real> values) const;
  /// values [R, C], a row per ray, each finite.
  void per_ray(const char* name, View<const Real> values) const;

 private:
  [[noreturn]] void fail(const char* name, std::int64_t row, const std::string& what) const;

  std::string_view pass_;
  std::int64_t first_ray_;
  const Samples<Real>& samples_;
};

}  // namespace semfield
