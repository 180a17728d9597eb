// Checked entry point of every sampler.
#include "plugin/sampler.h"

#include <algorithm>

#include "core/error.h"
#include "plugin/quadrature.h"
#include "plugin/reference.h"

namespace semfield {

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
  std::int64_t room = capacity(count, previous_per_ray);
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

}  // namespace semfield
