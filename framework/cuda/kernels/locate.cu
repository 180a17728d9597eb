// Encoder coordinates of samples and of positions.
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kSamples = 128;  // a block
constexpr int kThreads = 3 * kSamples;

// Coordinate `axis` of the place whose coordinates `p` gives: one alone where the map is affine.
template <class Place>
__device__ double mapped(const DomainMap& map, const Place& p, int axis) {
  return map.radius > 0 ? map({p(0), p(1), p(2)})[axis] : map.along(axis, p(axis));
}

// One thread a coordinate, so that a warp writes consecutive numbers. A row: 12 B of t, delta and ray and 24 B of x;
// the 48 B of a ray are read once for its samples and then found in cache.
__global__ void __launch_bounds__(kThreads)
    locate_kernel(Rays<float> rays, Samples<float> samples, DomainMap map, View<double> x, FaultKey* fault) {
  const std::int64_t m = static_cast<std::int64_t>(blockIdx.x) * kSamples + threadIdx.x / 3;
  const int axis = static_cast<int>(threadIdx.x % 3);
  if (m >= x.rows) return;
  if (m >= samples.first(rays.origin.rows, 0)) {
    x(m, axis) = map.offset;
    return;
  }
  const std::int32_t r = samples.ray_of_sample(m, 0);
  const float t = samples.t(m, 0);
  const auto place = [&](int a) { return rays.origin(r, a) + static_cast<double>(t) * rays.direction(r, a); };
  const double at = mapped(map, place, axis);
  x(m, axis) = at;
  bool sound = isfinite(at) && isfinite(t);
  if (axis == 0) {
    const float delta = samples.delta(m, 0);
    sound = sound && delta >= 0 && isfinite(delta);
  }
  if (!sound) note_fault(fault, Stage::samples, m);
}

// A warp per ray; 16 B per sample, and 72 B per ray.
__global__ void __launch_bounds__(kSamples)
    gradient_kernel(Rays<float> rays, Samples<float> samples, DomainMap map, View<const float> dx, View<float> d_ray) {
  const std::int64_t r = static_cast<std::int64_t>(blockIdx.x) * (kSamples / kWarp) + threadIdx.x / kWarp;
  if (r >= d_ray.rows) return;
  const int lane = static_cast<int>(threadIdx.x % kWarp);
  const std::int32_t end = samples.first(r + 1, 0);
  double sum[6] = {};
  for (std::int32_t m = samples.first(r, 0) + lane; m < end; m += kWarp) {
    const auto t = static_cast<double>(samples.t(m, 0));
    Vec3d p, d;
    for (int i = 0; i < 3; ++i) {
      p[i] = rays.origin(r, i) + t * rays.direction(r, i);
      d[i] = static_cast<double>(dx(m, i));
    }
    const Vec3d d_place = map.gradient(p, d);
    for (int i = 0; i < 3; ++i) {
      sum[i] += d_place[i];
      sum[3 + i] += d_place[i] * t;
    }
  }
  for (int i = 0; i < 6; ++i) {
    const double all = warp_sum(sum[i]);
    if (lane == 0) d_ray(r, i) += static_cast<float>(all);
  }
}

// One thread per coordinate; 48 B per row.
__global__ void __launch_bounds__(kThreads) map_kernel(View<const double> positions, DomainMap map, View<double> x) {
  const std::int64_t m = static_cast<std::int64_t>(blockIdx.x) * kSamples + threadIdx.x / 3;
  const int axis = static_cast<int>(threadIdx.x % 3);
  if (m < x.rows)
    x(m, axis) = mapped(
        map, [&](int a) { return positions(m, a); }, axis);
}

}  // namespace

void locate(const Rays<float>& rays, const Samples<float>& samples, const DomainMap& map, View<double> x) {
  queue("locating samples", blocks_of(x.rows, kSamples), kThreads, locate_kernel, rays, samples, map, x,
        launch().fault);
}

void locate_backward(const Rays<float>& rays, const Samples<float>& samples, const DomainMap& map, View<const float> dx,
                     View<float> d_ray) {
  queue("gradients of rays", blocks_of(d_ray.rows, kSamples / kWarp), kSamples, gradient_kernel, rays, samples, map, dx,
        d_ray);
}

void map_positions(View<const double> positions, const DomainMap& map, View<double> x) {
  queue("mapping positions", blocks_of(x.rows, kSamples), kThreads, map_kernel, positions, map, x);
}

}  // namespace semfield::cuda
