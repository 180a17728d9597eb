#include "surface/mesh/score/nearest_surface.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

namespace semfield {

namespace {

constexpr std::uint32_t kLeafTriangles = 8;
constexpr std::size_t kDeepest = 64;  // halves of 2^32 triangles end sooner

double square(double x) { return x * x; }

// Of the distance.
double square_to_box(const Box& box, Vec3d p) {
  double sum = 0;
  for (int axis = 0; axis < 3; ++axis) sum += square(std::max({box.lo[axis] - p[axis], 0.0, p[axis] - box.hi[axis]}));
  return sum;
}

double square_to_segment(Vec3d p, Vec3d a, Vec3d b) {
  const Vec3d along = b - a;
  const double size = dot(along, along), share = size > 0 ? std::clamp(dot(p - a, along) / size, 0.0, 1.0) : 0;
  const Vec3d off = p - (a + along * share);
  return dot(off, off);
}

// Above the triangle it is the distance to the plane, and elsewhere that to the nearest side.
double square_to_triangle(Vec3d p, Vec3d a, Vec3d b, Vec3d c) {
  const Vec3d normal = cross(b - a, c - a);
  const double size = dot(normal, normal);
  if (size > 0 && dot(cross(b - a, p - a), normal) >= 0 && dot(cross(c - b, p - b), normal) >= 0 &&
      dot(cross(a - c, p - c), normal) >= 0)
    return square(dot(p - a, normal)) / size;
  return std::min({square_to_segment(p, a, b), square_to_segment(p, b, c), square_to_segment(p, c, a)});
}

std::vector<Triangle> each_alone(std::size_t points) {
  std::vector<Triangle> out(points);
  for (std::uint32_t i = 0; i < points; ++i) out[i] = {i, i, i};
  return out;
}

}  // namespace

NearestSurface::NearestSurface(std::vector<Vec3d> positions, std::vector<Triangle> triangles)
    : positions_(std::move(positions)), triangles_(std::move(triangles)) {
  if (!triangles_.empty()) build(0, static_cast<std::uint32_t>(triangles_.size()));
}

NearestSurface::NearestSurface(std::vector<Vec3d> points) : positions_(std::move(points)) {
  triangles_ = each_alone(positions_.size());
  if (!triangles_.empty()) build(0, static_cast<std::uint32_t>(triangles_.size()));
}

Vec3d NearestSurface::middle(const Triangle& t) const {
  return (positions_[t[0]] + positions_[t[1]] + positions_[t[2]]) * (1.0 / 3);
}

std::uint32_t NearestSurface::build(std::uint32_t first, std::uint32_t end) {
  const auto number = static_cast<std::uint32_t>(nodes_.size());
  Node node;
  node.first = first;
  node.end = end;
  Box middles;
  for (std::uint32_t i = first; i < end; ++i) {
    for (const std::uint32_t v : triangles_[i]) node.box.include(positions_[v]);
    middles.include(middle(triangles_[i]));
  }
  nodes_.push_back(node);
  if (end - first <= kLeafTriangles) return number;
  const Vec3d size = middles.size();
  const int axis = size.x >= size.y && size.x >= size.z ? 0 : size.y >= size.z ? 1 : 2;
  const std::uint32_t half = first + (end - first) / 2;
  std::nth_element(triangles_.begin() + first, triangles_.begin() + half, triangles_.begin() + end,
                   [&](const Triangle& a, const Triangle& b) { return middle(a)[axis] < middle(b)[axis]; });
  build(first, half);
  const std::uint32_t second = build(half, end);
  nodes_[number].second = second;
  return number;
}

double NearestSurface::distance(Vec3d point, double most) const {
  if (nodes_.empty()) return most;
  struct Wait {
    std::uint32_t node;
    double square;
  };
  std::array<Wait, kDeepest> waiting;
  std::size_t count = 0;
  double best = square(most);
  waiting[count++] = {0, square_to_box(nodes_[0].box, point)};
  while (count > 0) {
    const Wait next = waiting[--count];
    if (!(next.square < best)) continue;
    const Node& node = nodes_[next.node];
    if (node.second == 0) {
      for (std::uint32_t i = node.first; i < node.end; ++i) {
        const Triangle& t = triangles_[i];
        best = std::min(best, square_to_triangle(point, positions_[t[0]], positions_[t[1]], positions_[t[2]]));
      }
      continue;
    }
    Wait near{next.node + 1, square_to_box(nodes_[next.node + 1].box, point)};
    Wait far{node.second, square_to_box(nodes_[node.second].box, point)};
    if (far.square < near.square) std::swap(near, far);
    waiting[count++] = far;
    waiting[count++] = near;
  }
  return std::sqrt(best);
}

}  // namespace semfield
