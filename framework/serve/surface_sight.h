// Places on the surface as cameras see them: clicks of other views, and the photograph that shows a place best.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "labels/clicks/annotations.h"
#include "serve/label_state.h"
#include "surface/surface_pool.h"

namespace semfield {

/// Image point where a camera sees a world position; nothing behind the camera or outside of its image.
std::optional<PixelPoint> pixel_of(const RayCamera& camera, Vec3d place);

/// Distance to the surface along the ray of a pixel, 0 where the ray meets nothing.
using SurfaceDistance = std::function<double(std::int32_t column, std::int32_t row)>;
/// Of a map; 0 everywhere for one that is not made yet.
SurfaceDistance distance_in(const SurfaceMap& map);

/// pixel_of() where the place lies on the surface that the camera sees there, up to `tolerance_m` or 3 % of the
/// distance; nothing where something hides it.
std::optional<PixelPoint> seen_at(const RayCamera& camera, const SurfaceDistance& distance, Vec3d place,
                                  double tolerance_m);

/// Where clicks lie on the surface, by the maps of their views: up to eight places of a click.
class MarkPlaces {
 public:
  /// `view_of_frame`: numbers in `views` by frame of the scene, -1 for none.
  void set(std::span<const Annotations::Mark> marks, std::span<const int> view_of_frame);
  /// The latest clicks, at most 1,000, that a camera sees; those of view `own` are left out (-1: none). Maps that were
  /// made anew are read anew.
  std::vector<SeenMark> seen_by(const RayCamera& camera, const SurfaceDistance& distance, int own,
                                std::span<const PoolView> views, const RayLimits& limits, double tolerance_m);

 private:
  struct Placed {
    std::string id;
    int view = -1;
    std::vector<PixelPlace> pixels;
    std::vector<Vec3d> places;
    std::int64_t step = -1;  // of the map that gave the places
  };
  std::vector<Placed> marks_;
};

/// The view that shows a place of the surface best: from near, in its middle, with nothing before it. Views without a
/// map see nothing.
std::optional<Spot> best_spot(std::span<const PoolView> views, Vec3d place, double tolerance_m);
/// The view whose camera is like this one: near it, and with the same direction. `scale_m`: a way that counts as much
/// as a turn of 90 degrees.
int nearest_view(std::span<const PoolView> views, const Pose& world_from_camera, double scale_m);

}  // namespace semfield
