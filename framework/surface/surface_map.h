// Where the rays of a camera's pixels meet the field: the surface that labels lie on.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "eval/pixel_stride.h"
#include "eval/rays.h"
#include "execution/pipeline.h"

namespace semfield {

/// Distances along the rays of every `stride`-th pixel (eval/pixel_stride.h), row-major.
struct SurfaceMap {
  std::int32_t stride = 0;  ///< 0: not made yet
  std::int32_t width_px = 0, height_px = 0;
  std::vector<float> distance_m;  ///< [height * width] along the ray; 0: the ray meets nothing
  std::int64_t step = 0;          ///< of training, when it was made

  bool empty() const { return stride == 0; }
  /// The map's value at a pixel of the frame.
  float at(std::int32_t column, std::int32_t row) const;
};

/// Whether training has moved so far since the map was made that it is made anew. `step` is that of training.
inline bool is_stale(const SurfaceMap& map, std::int64_t step) {
  return static_cast<double>(step) > 1.6 * static_cast<double>(map.step) + 50;
}

/// A ray that keeps less opacity than this meets nothing.
inline constexpr float kSurfaceOpacity = 0.5F;

/// Expected distance divided by opacity, at these pixels; 0 where opacity is below kSurfaceOpacity. Colours and labels
/// are not computed. Throws as Pipeline::render.
std::vector<float> surface_distances(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                                     std::span<const PixelPlace> pixels);

SurfaceMap make_surface_map(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                            std::int32_t stride, std::int64_t step);

/// World position on the pixel's ray.
Vec3d point_at(const RayCamera& camera, const RayLimits& limits, const PixelPlace& pixel, double distance_m);

}  // namespace semfield
