// A length that stands for a metre, so that a default which is meant for rooms suits a scene in any unit.
#pragma once

#include <algorithm>
#include <cmath>

#include "core/small_math.h"

namespace semfield {

/// Whether a scene of this size is in metres: as large as shelves, rooms and houses are.
inline bool is_in_metres(bool metric, Vec3d size) {
  const double longest = std::max({size.x, size.y, size.z});
  return metric && longest >= 0.1 && longest <= 100;
}

/// 1 where is_in_metres(), else a fifth of the scene's longest side; 1 for a scene without a size.
inline double usual_metre(bool metric, Vec3d size) {
  const double longest = std::max({size.x, size.y, size.z});
  return is_in_metres(metric, size) || !(longest > 0) || !std::isfinite(longest) ? 1 : longest / 5;
}

}  // namespace semfield
