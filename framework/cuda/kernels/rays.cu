// Rays on the device: encoder coordinates of their samples and of positions, and corrections of training cameras with
// the meaning of model/camera_corrections.h, whose sums go over the rays of a camera in a fixed tree.
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"
#include "model/camera_corrections.h"

namespace semfield::cuda {

namespace {

constexpr int kSamples = 128;  // a block
constexpr int kCoordinateThreads = 3 * kSamples;

// Coordinate `axis` of the place whose coordinates `p` gives: one alone where the map is affine.
template <class Place>
__device__ double mapped(const DomainMap& map, const Place& p, int axis) {
  return map.radius > 0 ? map({p(0), p(1), p(2)})[axis] : map.along(axis, p(axis));
}

// One thread a coordinate, so that a warp writes consecutive numbers. A row: 12 B of t, delta and ray and 24 B of x;
// the 48 B of a ray are read once for its samples and then found in cache.
__global__ void __launch_bounds__(kCoordinateThreads)
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
__global__ void __launch_bounds__(kCoordinateThreads)
    map_kernel(View<const double> positions, DomainMap map, View<double> x) {
  const std::int64_t m = static_cast<std::int64_t>(blockIdx.x) * kSamples + threadIdx.x / 3;
  const int axis = static_cast<int>(threadIdx.x % 3);
  if (m < x.rows)
    x(m, axis) = mapped(
        map, [&](int a) { return positions(m, a); }, axis);
}

constexpr int kThreads = 128;

// A block per column; 8 B per row.
__global__ void __launch_bounds__(kThreads)
    centre_kernel(View<const float> from, double share, View<float> to, bool add) {
  __shared__ double mean;
  const auto column = static_cast<std::int32_t>(blockIdx.x);
  double sum = 0;
  for (std::int64_t r = threadIdx.x; r < from.rows; r += kThreads) sum += static_cast<double>(from(r, column));
  sum = block_sum<kThreads>(sum);
  if (threadIdx.x == 0) mean = share * sum / static_cast<double>(from.rows);
  __syncthreads();
  for (std::int64_t r = threadIdx.x; r < from.rows; r += kThreads) {
    const auto centred = static_cast<float>(static_cast<double>(from(r, column)) - mean);
    to(r, column) = add ? to(r, column) + centred : centred;
  }
}

__device__ Vec3d rotation_of(const float* pose) {
  return {static_cast<double>(pose[0]), static_cast<double>(pose[1]), static_cast<double>(pose[2])};
}

// One thread per ray: 100 B read, 96 B of them written.
__global__ void __launch_bounds__(kThreads)
    move_kernel(View<const float> camera, View<const float> pose, double distance_m, View<double> origin,
                View<double> direction) {
  const std::int64_t r = thread_index();
  if (r >= camera.rows) return;
  const float* const row = pose.row(static_cast<std::int64_t>(camera(r, 0)));
  const Vec3d moved = rotated(rotation_of(row), {direction(r, 0), direction(r, 1), direction(r, 2)});
  for (int i = 0; i < 3; ++i) {
    direction(r, i) = moved[i];
    origin(r, i) += distance_m * static_cast<double>(row[3 + i]);
  }
}

// A block per camera looks for its rays: 4 B of each ray, 52 B of its own.
__global__ void __launch_bounds__(kThreads)
    move_backward_kernel(View<const float> camera, View<const float> pose, double distance_m,
                         View<const double> direction, View<const float> d_ray, View<float> d_pose) {
  const std::int64_t of = blockIdx.x;
  const Vec3d rotation = rotation_of(pose.row(of));
  double sum[kPoseNumbers] = {};
  for (std::int64_t r = threadIdx.x; r < camera.rows; r += kThreads) {
    if (static_cast<std::int64_t>(camera(r, 0)) != of) continue;
    const Vec3d moved{direction(r, 0), direction(r, 1), direction(r, 2)};
    const Vec3d d_moved{static_cast<double>(d_ray(r, 3)), static_cast<double>(d_ray(r, 4)),
                        static_cast<double>(d_ray(r, 5))};
    const Vec3d d_rotation = rotation_gradient(rotation, moved, d_moved);
    for (int i = 0; i < 3; ++i) {
      sum[i] += d_rotation[i];
      sum[3 + i] += distance_m * static_cast<double>(d_ray(r, i));
    }
  }
  for (int i = 0; i < kPoseNumbers; ++i) {
    const double all = block_sum<kThreads>(sum[i]);
    if (threadIdx.x == 0) d_pose(of, i) += static_cast<float>(all);
  }
}

// One thread per ray.
__global__ void __launch_bounds__(kThreads)
    show_kernel(View<const float> camera, View<const float> map, View<const float> color, View<float> shown) {
  const std::int64_t r = thread_index();
  if (r < camera.rows) shown_color(map.row(static_cast<std::int64_t>(camera(r, 0))), color.row(r), shown.row(r));
}

__global__ void __launch_bounds__(kThreads) show_gradient_kernel(View<const float> camera, View<const float> map,
                                                                 View<const float> d_shown, View<float> d_color) {
  const std::int64_t r = thread_index();
  if (r >= camera.rows) return;
  shown_color_gradient(map.row(static_cast<std::int64_t>(camera(r, 0))), d_shown.row(r), d_color.row(r));
}

// A block per camera, as move_backward_kernel.
__global__ void __launch_bounds__(kThreads) map_gradient_kernel(View<const float> camera, View<const float> color,
                                                                View<const float> d_shown, View<float> d_map) {
  const std::int64_t of = blockIdx.x;
  double sum[kColorNumbers] = {};
  for (std::int64_t r = threadIdx.x; r < camera.rows; r += kThreads) {
    if (static_cast<std::int64_t>(camera(r, 0)) != of) continue;
    for (int i = 0; i < 3; ++i) {
      const auto d = static_cast<double>(d_shown(r, i));
      for (int j = 0; j < 3; ++j) sum[4 * i + j] += d * static_cast<double>(color(r, j));
      sum[4 * i + 3] += d;
    }
  }
  for (int i = 0; i < kColorNumbers; ++i) {
    const double all = block_sum<kThreads>(sum[i]);
    if (threadIdx.x == 0) d_map(of, i) += static_cast<float>(all);
  }
}

void centre(View<const float> from, double share, View<float> to, bool add) {
  queue("centring corrections of cameras", static_cast<unsigned>(from.cols), kThreads, centre_kernel, from, share, to,
        add);
}

void move(View<const float> camera, View<const float> pose, double distance_m, View<double> origin,
          View<double> direction) {
  queue("moving rays", blocks_of(camera.rows, kThreads), kThreads, move_kernel, camera, pose, distance_m, origin,
        direction);
}

void move_backward(View<const float> camera, View<const float> pose, double distance_m, View<const double> direction,
                   View<const float> d_ray, View<float> d_pose) {
  queue("gradients of poses", static_cast<unsigned>(d_pose.rows), kThreads, move_backward_kernel, camera, pose,
        distance_m, direction, d_ray, d_pose);
}

void show(View<const float> camera, View<const float> map, View<const float> color, View<float> shown) {
  queue("colours of cameras", blocks_of(camera.rows, kThreads), kThreads, show_kernel, camera, map, color, shown);
}

void show_backward(View<const float> camera, View<const float> map, View<const float> color, View<const float> d_shown,
                   View<float> d_color, View<float> d_map) {
  queue("gradients of colours", blocks_of(camera.rows, kThreads), kThreads, show_gradient_kernel, camera, map, d_shown,
        d_color);
  queue("gradients of colours of cameras", static_cast<unsigned>(d_map.rows), kThreads, map_gradient_kernel, camera,
        color, d_shown, d_map);
}

// A slow copy follows: 12 B per number.

constexpr int kFollowThreads = 256;

__global__ void __launch_bounds__(kFollowThreads)
    follow_kernel(const float* value, float* slow, std::int64_t count, float kept, float taken) {
  const std::int64_t i = thread_index();
  if (i < count) slow[i] = kept * slow[i] + taken * value[i];
}

}  // namespace

void locate(const Rays<float>& rays, const Samples<float>& samples, const DomainMap& map, View<double> x) {
  queue("locating samples", blocks_of(x.rows, kSamples), kCoordinateThreads, locate_kernel, rays, samples, map, x,
        launch().fault);
}

void locate_backward(const Rays<float>& rays, const Samples<float>& samples, const DomainMap& map, View<const float> dx,
                     View<float> d_ray) {
  queue("gradients of rays", blocks_of(d_ray.rows, kSamples / kWarp), kSamples, gradient_kernel, rays, samples, map, dx,
        d_ray);
}

void map_positions(View<const double> positions, const DomainMap& map, View<double> x) {
  queue("mapping positions", blocks_of(x.rows, kSamples), kCoordinateThreads, map_kernel, positions, map, x);
}

const CameraKernels<float>& camera_kernels() {
  static const CameraKernels<float> table{centre, move, move_backward, show, show_backward};
  return table;
}

void follow(std::span<const float> value, std::span<float> slow, double share) {
  const auto count = static_cast<std::int64_t>(slow.size());
  queue("slow copy of a network", blocks_of(count, kFollowThreads), kFollowThreads, follow_kernel, value.data(),
        slow.data(), count, static_cast<float>(share), static_cast<float>(1 - share));
}

}  // namespace semfield::cuda
