// Group F: geometry, cameras and meshes.
#include "geometry_parts.h"

namespace semfield::numerics {

namespace {

constexpr Case kCases[] = {
    {"F01", "on-face", "rays along and across the faces, edges and corners they start on", "long double", box_on_face},
    {"F02", "parallel-out", "rays parallel to a slab, outside by a metre down to one rounding", "exact",
     box_parallel_outside},
    {"F03", "inside/corner/behind", "125 places in, on and around a box, 52 directions", "rational numbers",
     box_every_place},
    {"F04", "thin-box", "boxes of thickness 0 along one, two and three axes", "exact", box_thin},
    {"F05", "quat", "quaternions of COLMAP poses: 0, norms 1e-100 to 1e100, q and -q", "long double",
     quaternion_scales},
    {"F06", "rot-check", "mirrored, scaled and skewed rotations", "|R^T R - I|", rotation_check},
    {"F07", "so3-exp", "turns of 0, 1e-12, 1e-8, pi - 1e-9 and pi between two poses", "long double", rotation_between},
    {"F08", "bad-pose", "trajectory rows of NaN and -inf", "exact", bad_pose},
    {"F09", "intrinsics", "focal lengths <= 0, principal point outside, a lens that folds", "long double", intrinsics},
    {"F10", "utm", "scenes 1e3 to 1e6 m from the origin", "scene at the origin", far_origin},
    {"F11", "sliver", "triangles of no area, area 1e-12, given twice", "exact", slivers},
    {"F12", "mesh-bad", "OBJ files with wrong indices, NaN, no faces; a PLY file", "exact", bad_meshes},
};

}  // namespace

std::span<const Case> geometry_cases() { return kCases; }

}  // namespace semfield::numerics
