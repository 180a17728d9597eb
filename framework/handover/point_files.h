// Labelled points in formats of other programs.
#pragma once

#include <string>

#include "surface/mesh/mesh_files.h"

namespace semfield {

/// PCD 0.7, binary: x y z (float, less `offset`), normal_x normal_y normal_z, rgb (as PCL packs it); with semantics
/// label (uint: the id) and entropy (float, nats); with objects instance (uint, 0 = none).
void write_pcd(const std::string& path, const PointSet& points, const ClassTable& classes, Vec3d offset);

/// LAS 1.4, point format 7: whole steps of a millionth of the box's decade(), a thousandth of a millimetre in a room,
/// from the middle of the box in whole decades (both in the header); colours with 16 bits; classification: the class's
/// id, 255 for one above 254. Extra bytes, which the header describes: label (uint16: the id), entropy (float) and,
/// with objects, instance (uint32). A table of classification names, of 15 bytes each. No coordinate system of the
/// earth is named. Returns the offset of the header, which readers add by themselves.
Vec3d write_las(const std::string& path, const PointSet& points, const ClassTable& classes);

}  // namespace semfield
