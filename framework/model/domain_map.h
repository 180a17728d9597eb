// From world positions to an encoder's coordinates: one affine map, the same for every sample of a run.
#pragma once

#include "core/small_math.h"
#include "plugin/encoder.h"

namespace semfield {

/// x = (p - center) * scale + offset.
struct DomainMap {
  Vec3d center;
  double scale = 1;
  double offset = 0;

  /// unit_cube: the longest side of `bounds` spans [0, 1] (isotropic, so cells are cubes). metric: p * scene_scale when
  /// it is given [Zhi21, Sec. 4: 0.1]; scene_scale 0 derives centre and scale so that `bounds` fits [-1, 1].
  static DomainMap make(Domain domain, const Box& bounds, double scene_scale) {
    const Vec3d size = bounds.size();
    const double longest = std::fmax(size.x, std::fmax(size.y, size.z));
    if (domain == Domain::unit_cube) return {bounds.center(), 1 / longest, 0.5};
    if (scene_scale > 0) return {{0, 0, 0}, scene_scale, 0};
    return {bounds.center(), 2 / longest, 0};
  }
};

}  // namespace semfield
