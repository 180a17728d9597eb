// Which way is up, as cameras show it, and the turn that a y-up viewer needs.
#pragma once

#include <array>
#include <optional>
#include <span>
#include <string>

#include "core/small_math.h"

namespace semfield {

/// The mean of the cameras' up vectors as a unit vector; the axis of the world that it lies within 20 degrees of, where
/// there is one. Nothing where they cancel.
std::optional<Vec3d> up_of_cameras(std::span<const Pose> world_from_camera);

/// x, y, z or one of them with a sign before it; nothing for anything else.
std::optional<Vec3d> axis_named(const std::string& name);
/// "+z", or the numbers of a direction that is no axis.
std::string axis_text(Vec3d up);

/// Quaternion x, y, z, w of the smallest turn from `up`, a unit vector, to +y.
std::array<double, 4> turn_to_y(Vec3d up);

}  // namespace semfield
