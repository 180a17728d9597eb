// Surfaces and points as files: PLY, OBJ with MTL, GLB. Positions are written in the world frame and scale they have.
#pragma once

#include <span>
#include <string>

#include "scene/classes/class_table.h"
#include "surface/mesh/surface.h"

namespace semfield {

/// Points without triangles: labelled point clouds.
struct PointSet {
  std::vector<Vec3d> positions;
  PointAttributes attributes;
};

/// Binary little-endian PLY. Vertices: x y z (double), nx ny nz (float), red green blue (uchar) and, with semantics,
/// label (int: the id of the class table), scalar_label (float: the same, as CloudCompare has scalar fields) and
/// entropy (float, nats); faces: vertex_indices. Open3D reads label from files with int, and none with ushort.
void write_ply(const std::string& path, const Surface& surface, const ClassTable& classes);
/// The same without normals and faces.
void write_ply(const std::string& path, const PointSet& points, const ClassTable& classes);

/// OBJ: vertices with colours behind their coordinates (0..1), normals, and one group of faces with one material per
/// class; beside it `path` with .mtl, in which Kd is the class's colour in linear light. Materials carry the classes'
/// names, with blanks as '_'; two that would be equal get their id behind. Without semantics one material 'surface'.
void write_obj(const std::string& path, const Surface& surface, const ClassTable& classes);

/// How a viewer shows a GLB file.
struct GlbLook {
  Vec3d up{0, 1, 0};   ///< unit vector of the world that is upright
  bool unlit = false;  ///< colours hold the light already: they are shown as they are (KHR_materials_unlit)
};

/// glTF 2.0 binary: one primitive and one material per class, each with vertices of its own: POSITION, NORMAL, COLOR_0
/// (linear light, 16 bits) and, with semantics, _LABEL (the id, 16 bits) and _ENTROPY (nats). Materials are
/// single-sided, so that a room seen from outside is open; their extras hold class_id and the class's colour. Positions
/// are in the input's world, rounded to 32 bits; the one node turns `up` to +y, and asset.extras say so. Throws
/// Error(data) for files over 4 GiB.
void write_glb(const std::string& path, const Surface& surface, const ClassTable& classes, const GlbLook& look);

}  // namespace semfield
