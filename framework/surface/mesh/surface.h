// A triangle surface in world coordinates with what is known of each vertex; every writer and filter works on it.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "core/small_math.h"

namespace semfield {

/// What rendering shows of a point on a surface. `label` and `entropy` are empty without semantics, `instance` without
/// objects. Filters of surfaces keep the first three; objects are looked up when the surface has its faces.
struct PointAttributes {
  std::vector<std::array<std::uint8_t, 3>> color;  ///< display-referred, as PNG output
  std::vector<std::int16_t> label;                 ///< class index, kVoid = none
  std::vector<float> entropy;                      ///< nats
  std::vector<std::int32_t> instance;              ///< id of the object, 0 = none

  bool has_labels() const { return !label.empty(); }
  bool has_instances() const { return !instance.empty(); }
};

using Triangle = std::array<std::uint32_t, 3>;

/// Triangles run counter-clockwise seen from the empty side. Vertices are shared.
struct Surface {
  std::vector<Vec3d> positions;  ///< world, metres (or the scene's unit)
  std::vector<Vec3d> normals;    ///< unit, towards the empty side; as many as positions once set
  std::vector<Triangle> triangles;
  PointAttributes attributes;  ///< per vertex; empty until the surface is textured
};

double area_of(const Surface& surface, const Triangle& triangle);

/// Unit normals of vertices: the mean of the triangles around, weighted by area. A vertex without area around it gets
/// {0, 0, 1}.
void set_vertex_normals(Surface& surface);

/// Pieces that share vertices: the part that each vertex belongs to, and the triangles of each part.
struct Components {
  std::vector<std::uint32_t> of_vertex;
  std::vector<std::int64_t> faces;
};
Components components_of(const Surface& surface);

/// Edges between vertices, both ways: those of vertex v are to[first[v]] ... to[first[v + 1] - 1], once for each of
/// their triangles.
struct Edges {
  std::vector<std::uint32_t> first, to;
};
Edges edges_of(const Surface& surface);
/// How many edges separate each vertex from the nearest one whose flag is set, and which that is; where none is
/// connected: kNever, and the vertex itself.
struct Reach {
  static constexpr int kNever = 1 << 30;
  std::vector<int> rings;
  std::vector<std::uint32_t> nearest;
};
Reach reach_of(const Edges& edges, std::span<const char> flags);
/// Flags grown by so many rings of vertices; shrunk, where `rings` is negative.
std::vector<char> grown(const Edges& edges, std::vector<char> flags, int rings);

/// Takes bumps off without shrinking what is larger [Taubin95]: each round moves vertices to the mean of their
/// neighbours and back again. Normals are set anew.
void smooth(Surface& surface, int rounds);

/// Drops components with fewer than `min_share` of all triangles, then vertices without a triangle; order is kept.
/// Returns the number of components that stay.
std::int64_t drop_small_components(Surface& surface, double min_share);

/// Keeps triangles whose flag is set, and the vertices that they use with what is known of them.
void keep_triangles(Surface& surface, const std::vector<char>& keep);

/// Quaternion x, y, z, w of the smallest turn from `up`, a unit vector, to +y.
std::array<double, 4> turn_to_y(Vec3d up);

}  // namespace semfield
