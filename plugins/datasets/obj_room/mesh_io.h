// Triangle meshes from OBJ + MTL files; mesh_io.cpp is the only user of tinyobjloader.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/small_math.h"

namespace semfield {

using Vec3f = Vec3<float>;

/// Appearance of a surface: lambertian colour, emission and cut-outs.
struct Material {
  std::string name;
  std::array<float, 3> diffuse{0.6f, 0.6f, 0.6f};  ///< Kd, linear
  std::array<float, 3> emission{};                 ///< Ke, linear; multiplied by the colour texture when there is one
  float opacity = 1;                               ///< d; below 0.5 the surface lets rays through
  std::string diffuse_map;                         ///< map_Kd, path as resolved from the MTL's folder; "" = none
  std::string opacity_map;                         ///< map_d, likewise
};

/// A triangle soup with names. Per-triangle vectors have one element a triangle.
struct TriangleMesh {
  std::vector<Vec3f> positions;                         ///< file units (metres)
  std::vector<std::array<std::uint32_t, 3>> triangles;  ///< indices into positions
  std::vector<std::array<std::array<float, 2>, 3>> uv;  ///< per corner, v up; zeros where the file has none
  std::vector<std::array<Vec3f, 3>> normals;            ///< per corner, unit; zero vectors where the file has none
  std::vector<std::int32_t> material_of;                ///< index into materials, -1 = none named or not found
  std::vector<std::int32_t> object_of;                  ///< index into objects
  std::vector<std::int32_t> piece_of;                   ///< what instances are by; empty: object_of
  std::vector<std::int32_t> group_of;                   ///< index into groups
  std::vector<Material> materials;
  std::vector<std::string> objects;  ///< `o` names (the `g` names of a file without `o`), file order
  std::vector<std::string> groups;   ///< `g` names, "" = none
  Box bounds;
  std::int64_t zero_area_skipped = 0;

  std::size_t size() const { return triangles.size(); }
  /// Corner k of a triangle in float64.
  Vec3d corner(std::size_t triangle, std::size_t k) const {
    const Vec3f p = positions[triangles[triangle][k]];
    return {p.x, p.y, p.z};
  }
  /// Along its normal, as long as twice its area.
  Vec3d cross_of_sides(std::size_t triangle) const {
    const Vec3d a = corner(triangle, 0);
    return cross(corner(triangle, 1) - a, corner(triangle, 2) - a);
  }
};

/// Reads an OBJ file with its MTL files. Polygons are cut into triangles, negative indices count back from the last
/// vertex, faces without area are skipped and counted. Missing MTL files, materials and texture files become warnings
/// that name them (surfaces without a material get a colour by object). Throws Error(no_input) for a missing file and
/// Error(data) with file and line for vertices that are not finite numbers, faces with fewer than three corners,
/// indices out of range and files without any triangle.
TriangleMesh load_obj(const std::string& path, Diagnostics& diagnostics);

/// Cuts a planar polygon with n >= 3 corners into n - 2 triangles of corner numbers, keeping its orientation; ear
/// clipping, so that concave polygons come out right. Falls back to a fan for polygons that cross themselves.
std::vector<std::array<int, 3>> triangulate_polygon(const std::vector<Vec3f>& corners);

// Pieces of a mesh: what is of one class and touches, whatever the names and materials of its parts.

/// The piece of each triangle, numbered from 0 on in the order of the first triangles. Triangles of one class
/// (`class_of`, one a triangle) are of one piece where points of them lie within about `gap_m` of each other.
std::vector<std::int32_t> pieces_of(const TriangleMesh& mesh, const std::vector<std::int16_t>& class_of, double gap_m);

}  // namespace semfield
