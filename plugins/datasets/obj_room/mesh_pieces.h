// Pieces of a mesh: what is of one class and touches, whatever the names and materials of its parts.
#pragma once

#include <cstdint>
#include <vector>

#include "datasets/obj_room/mesh_io.h"

namespace semfield {

/// The piece of each triangle, numbered from 0 on in the order of the first triangles. Triangles of one class
/// (`class_of`, one a triangle) are of one piece where points of them lie within about `gap_m` of each other.
std::vector<std::int32_t> pieces_of(const TriangleMesh& mesh, const std::vector<std::int16_t>& class_of, double gap_m);

}  // namespace semfield
