// Rotations of poses: the nearest one to a matrix, and quaternions.
#pragma once

#include <array>

#include "core/small_math.h"

namespace semfield {

/// w, x, y, z.
using Quaternion = std::array<double, 4>;

/// Puts the rotation in place of the pose's 3 x 3 part that is nearest to it, by the Frobenius norm. The part must be
/// finite and its determinant positive.
void make_rotation(Pose& pose);

Quaternion quaternion_of(const Pose& pose);

/// The turn of the quaternion, whose length does not matter. One that is zero or not finite gives a pose that is not
/// finite.
void set_rotation(Pose& pose, const Quaternion& turn);

}  // namespace semfield
