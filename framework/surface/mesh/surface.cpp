#include "surface/mesh/surface.h"

#include <cmath>

#include "core/check.h"
#include "core/joined_sets.h"
#include "scene/classes/class_table.h"

namespace semfield {

double area_of(const Surface& surface, const Triangle& t) {
  const Vec3d &a = surface.positions[t[0]], &b = surface.positions[t[1]], &c = surface.positions[t[2]];
  return 0.5 * length(cross(b - a, c - a));
}

void set_vertex_normals(Surface& surface) {
  surface.normals.assign(surface.positions.size(), Vec3d{});
  for (const Triangle& t : surface.triangles) {
    const Vec3d &a = surface.positions[t[0]], &b = surface.positions[t[1]], &c = surface.positions[t[2]];
    const Vec3d area = cross(b - a, c - a);
    for (const std::uint32_t v : t) surface.normals[v] = surface.normals[v] + area;
  }
  for (Vec3d& n : surface.normals) {
    const double size = length(n);
    n = size > 0 ? n * (1 / size) : Vec3d{0, 0, 1};
  }
}

Components components_of(const Surface& surface) {
  JoinedSets sets(surface.positions.size());
  for (const Triangle& t : surface.triangles)
    for (std::size_t corner = 1; corner < 3; ++corner) sets.join(t[0], t[corner]);
  Components out;
  out.of_vertex.resize(surface.positions.size());
  for (std::uint32_t v = 0; v < out.of_vertex.size(); ++v) {
    const std::uint32_t r = sets.of(v);
    if (r == v) {
      out.of_vertex[v] = static_cast<std::uint32_t>(out.faces.size());
      out.faces.push_back(0);
    } else {
      out.of_vertex[v] = out.of_vertex[r];  // r < v: already numbered
    }
  }
  for (const Triangle& t : surface.triangles) ++out.faces[out.of_vertex[t[0]]];
  return out;
}

std::int64_t drop_small_components(Surface& surface, double min_share) {
  const Components parts = components_of(surface);
  const double least = min_share * static_cast<double>(surface.triangles.size());
  std::int64_t kept = 0;
  for (const std::int64_t faces : parts.faces) kept += faces > 0 && static_cast<double>(faces) >= least ? 1 : 0;
  std::vector<char> keep(surface.triangles.size());
  for (std::size_t i = 0; i < keep.size(); ++i) {
    const std::int64_t faces = parts.faces[parts.of_vertex[surface.triangles[i][0]]];
    keep[i] = static_cast<double>(faces) >= least ? 1 : 0;
  }
  keep_triangles(surface, keep);
  return kept;
}

void keep_triangles(Surface& surface, const std::vector<char>& keep) {
  SEMFIELD_CHECK(keep.size() == surface.triangles.size(), "one flag per triangle");
  constexpr std::uint32_t kUnused = 0xFFFFFFFFU;
  std::vector<std::uint32_t> number(surface.positions.size(), kUnused);
  std::size_t triangles = 0;
  for (std::size_t i = 0; i < keep.size(); ++i) {
    if (keep[i] == 0) continue;
    for (const std::uint32_t v : surface.triangles[i]) number[v] = 0;
    surface.triangles[triangles++] = surface.triangles[i];
  }
  surface.triangles.resize(triangles);
  std::uint32_t vertices = 0;
  for (std::uint32_t& v : number) {
    if (v != kUnused) v = vertices++;
  }
  const auto compact = [&](auto& of_vertices) {
    if (of_vertices.empty()) return;
    for (std::size_t v = 0; v < number.size(); ++v) {
      if (number[v] != kUnused) of_vertices[number[v]] = of_vertices[v];
    }
    of_vertices.resize(vertices);
  };
  compact(surface.positions);
  compact(surface.normals);
  compact(surface.attributes.color);
  compact(surface.attributes.label);
  compact(surface.attributes.entropy);
  for (Triangle& t : surface.triangles) {
    for (std::uint32_t& v : t) v = number[v];
  }
}

Edges edges_of(const Surface& surface) {
  Edges edges;
  edges.first.assign(surface.positions.size() + 1, 0);
  for (const Triangle& t : surface.triangles) {
    for (const std::uint32_t v : t) edges.first[v + 1] += 2;
  }
  for (std::size_t v = 1; v < edges.first.size(); ++v) edges.first[v] += edges.first[v - 1];
  edges.to.resize(edges.first.back());
  std::vector<std::uint32_t> next(edges.first.begin(), edges.first.end() - 1);
  for (const Triangle& t : surface.triangles) {
    for (std::size_t k = 0; k < 3; ++k) {
      edges.to[next[t[k]]++] = t[(k + 1) % 3];
      edges.to[next[t[k]]++] = t[(k + 2) % 3];
    }
  }
  return edges;
}

Reach reach_of(const Edges& edges, std::span<const char> flags) {
  Reach reach;
  reach.rings.assign(flags.size(), Reach::kNever);
  reach.nearest.resize(flags.size());
  std::vector<std::uint32_t> reached;
  for (std::uint32_t v = 0; v < flags.size(); ++v) {
    reach.nearest[v] = v;
    if (flags[v] == 0) continue;
    reach.rings[v] = 0;
    reached.push_back(v);
  }
  for (std::size_t at = 0; at < reached.size(); ++at) {
    const std::uint32_t v = reached[at];
    for (std::uint32_t e = edges.first[v]; e < edges.first[v + 1]; ++e) {
      const std::uint32_t other = edges.to[e];
      if (reach.rings[other] != Reach::kNever) continue;
      reach.rings[other] = reach.rings[v] + 1;
      reach.nearest[other] = reach.nearest[v];
      reached.push_back(other);
    }
  }
  return reach;
}

std::vector<char> grown(const Edges& edges, std::vector<char> flags, int rings) {
  const bool grows = rings > 0;
  for (char& flag : flags) flag = (flag != 0) == grows ? 1 : 0;
  const Reach reach = reach_of(edges, flags);
  for (std::size_t v = 0; v < flags.size(); ++v) flags[v] = (reach.rings[v] <= std::abs(rings)) == grows ? 1 : 0;
  return flags;
}

void smooth(Surface& surface, int rounds) {
  const Edges edges = edges_of(surface);
  for (int round = 0; round < 2 * rounds; ++round) {
    const double share = round % 2 == 0 ? 0.5 : -0.53;
    const std::vector<Vec3d> before = surface.positions;
    for (std::size_t v = 0; v < before.size(); ++v) {
      const std::uint32_t first = edges.first[v], last = edges.first[v + 1];
      if (first == last) continue;
      Vec3d sum;
      for (std::uint32_t e = first; e < last; ++e) sum = sum + before[edges.to[e]];
      surface.positions[v] = before[v] + (sum * (1.0 / (last - first)) - before[v]) * share;
    }
  }
  set_vertex_normals(surface);
}

std::array<double, 4> turn_to_y(Vec3d up) {
  const Vec3d y{0, 1, 0};
  if (up.y < -1 + 1e-12) return {1, 0, 0, 0};  // upside down: half a turn about any level axis
  const Vec3d about = cross(up, y);
  const double w = 1 + dot(up, y), norm = std::sqrt(dot(about, about) + w * w);
  return {about.x / norm, about.y / norm, about.z / norm, w / norm};
}

}  // namespace semfield
