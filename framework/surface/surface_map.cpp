#include "surface/surface_map.h"

#include <algorithm>

#include "compute/float_mode.h"
#include "compute/parallel.h"

namespace semfield {

namespace {
constexpr std::int64_t kChunkRays = std::int64_t{1} << 16;
}

float SurfaceMap::at(std::int32_t column, std::int32_t row) const {
  const std::int32_t x = std::clamp(column / stride, 0, width_px - 1), y = std::clamp(row / stride, 0, height_px - 1);
  return distance_m[static_cast<std::size_t>(std::int64_t{y} * width_px + x)];
}

std::vector<float> surface_distances(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                                     std::span<const PixelPlace> pixels) {
  const WorkScope scope(pipeline.options().work);
  const ComputeFloatMode mode;
  const auto total = static_cast<std::int64_t>(pixels.size());
  const std::int64_t most = std::min(total, kChunkRays);
  std::vector<double> origin(3 * static_cast<std::size_t>(most)), direction(origin.size()),
      near_far(2 * static_cast<std::size_t>(most));
  std::vector<float> opacity(static_cast<std::size_t>(most)), distance(pixels.size());
  for (std::int64_t begin = 0; begin < total; begin += most) {
    const std::int64_t count = std::min(most, total - begin);
    parallel_for((count + 255) / 256, [&](std::int64_t block) {
      for (std::int64_t i = block * 256; i < std::min(count, (block + 1) * 256); ++i) {
        const auto k = static_cast<std::size_t>(i);
        const PixelPlace& pixel = pixels[static_cast<std::size_t>(begin) + k];
        cast_ray(camera, limits, pixel.column, pixel.row, &origin[3 * k], &direction[3 * k], &near_far[2 * k]);
      }
    });
    RenderJob<float> job;
    job.origin = {origin.data(), count, 3};
    job.direction = {direction.data(), count, 3};
    job.near_far = {near_far.data(), count, 2};
    job.depth = {distance.data() + begin, count, 1};
    job.opacity = {opacity.data(), count, 1};
    pipeline.render(job);
    for (std::int64_t i = 0; i < count; ++i) {
      const float met = opacity[static_cast<std::size_t>(i)];
      float& value = distance[static_cast<std::size_t>(begin + i)];
      value = met < kSurfaceOpacity ? 0.0F : value / met;
    }
  }
  return distance;
}

SurfaceMap make_surface_map(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                            std::int32_t stride, std::int64_t step) {
  SurfaceMap map;
  map.stride = std::clamp(stride, 1, std::min(camera.camera.width_px, camera.camera.height_px));
  map.width_px = strided_px(camera.camera.width_px, map.stride);
  map.height_px = strided_px(camera.camera.height_px, map.stride);
  map.step = step;
  std::vector<PixelPlace> pixels(static_cast<std::size_t>(std::int64_t{map.width_px} * map.height_px));
  for (std::size_t i = 0; i < pixels.size(); ++i)
    pixels[i] = strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride);
  map.distance_m = surface_distances(pipeline, camera, limits, pixels);
  return map;
}

Vec3d point_at(const RayCamera& camera, const RayLimits& limits, const PixelPlace& pixel, double distance_m) {
  double origin[3], direction[3], near_far[2];
  cast_ray(camera, limits, pixel.column, pixel.row, origin, direction, near_far);
  return {origin[0] + direction[0] * distance_m, origin[1] + direction[1] * distance_m,
          origin[2] + direction[2] * distance_m};
}

}  // namespace semfield
