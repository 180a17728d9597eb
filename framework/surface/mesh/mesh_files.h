// Surfaces and points as files: PLY, OBJ with MTL, GLB. Positions are written in the world frame and scale they have.
#pragma once

#include <map>
#include <span>
#include <string>

#include "scene/classes/class_table.h"
#include "surface/mesh/surface.h"

namespace semfield {

/// Points without triangles: labelled point clouds.
struct PointSet {
  std::vector<Vec3d> positions;
  std::vector<Vec3d> normals;    ///< unit, towards the eye; empty: not known
  std::vector<float> footprint;  ///< side of the square that a pixel saw of the surface there; empty: not known
  PointAttributes attributes;
};

/// Binary little-endian PLY. Vertices: x y z (double), nx ny nz (float), red green blue (uchar); with semantics label
/// (int: the id of the class table), scalar_label (float: the same, as CloudCompare has scalar fields), quality (float:
/// the same, as MeshLab has one), and entropy (float, nats); with objects instance and scalar_instance (their ids, 0 =
/// none). Faces: vertex_indices. Open3D reads label from files with int, and none with ushort.
void write_ply(const std::string& path, const Surface& surface, const ClassTable& classes);
/// The same without faces, and without normals where there are none.
void write_ply(const std::string& path, const PointSet& points, const ClassTable& classes);

/// OBJ: vertices with colours behind their coordinates (0..1), normals, and one group of faces with one material per
/// class; beside it `path` with .mtl, in which Kd is the class's colour in linear light. Materials carry the classes'
/// names, with blanks as '_'; two that would be equal get their id behind. Without semantics one material 'surface'.
void write_obj(const std::string& path, const Surface& surface, const ClassTable& classes);

/// How a viewer shows a GLB file.
struct GlbLook {
  Vec3d up{0, 1, 0};   ///< unit vector of the world that is upright
  bool unlit = false;  ///< colours hold the light already: they are shown as they are (KHR_materials_unlit)
  std::map<std::int32_t, std::string> objects{};  ///< names by id; one that is not there is "object 3"
};

/// glTF 2.0 binary: one primitive per class and one material, each primitive with vertices of its own: POSITION,
/// NORMAL, COLOR_0 (linear light, 16 bits) and, with semantics, _LABEL (the id, 16 bits) and _ENTROPY (nats). Materials
/// are single-sided, so that a room seen from outside is open; their extras hold class_id and the class's colour. An
/// object is a node "chair 3" with a mesh of its own, whose extras hold object_id; the rest is the mesh of the root.
/// Positions are in the input's world less offset_of_floats, rounded to 32 bits; the root turns `up` to +y and moves
/// them back, and asset.extras say both. Throws Error(data) for files over 4 GiB.
void write_glb(const std::string& path, const Surface& surface, const ClassTable& classes, const GlbLook& look);

/// What coordinates of 32 bits are counted from: 0, or, where one is 1,024 times as large as the box or more, the
/// middle of the box in whole hundreds of its decade().
Vec3d offset_of_floats(const Box& box);
/// The power of ten that the longest side of a box has: 1 for 1 to 9.99. 1 for a box without a size.
double decade(const Box& box);
Box box_around(std::span<const Vec3d> positions);

}  // namespace semfield
