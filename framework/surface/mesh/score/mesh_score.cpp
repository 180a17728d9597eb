#include "surface/mesh/score/mesh_score.h"

#include <algorithm>
#include <cmath>
#include <unordered_set>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/rng.h"

namespace semfield {

namespace {

constexpr std::int64_t kPiece = 1024;  // points that a thread takes at once
constexpr RandomAddress kOfMesh{0, 0, stream_id("score/mesh")};

// 21 bits an axis; what lies two million cubes apart may share a number, and one of the two is then lost.
std::uint64_t cube_of(Vec3d p, double cube) {
  std::uint64_t key = 0;
  for (int axis = 0; axis < 3; ++axis)
    key = key << 21 | (static_cast<std::uint64_t>(static_cast<std::int64_t>(std::floor(p[axis] / cube))) & 0x1FFFFF);
  return key;
}

// The first point of every cube, in the order of views and pixels.
std::vector<Vec3d> thinned(std::initializer_list<std::span<const DepthView>> all, double cube) {
  std::vector<Vec3d> points;
  std::unordered_set<std::uint64_t> taken;
  for (const std::span<const DepthView> views : all) {
    for (const DepthView& view : views) {
      for (std::size_t i = 0; i < view.map.distance_m.size(); ++i) {
        const float distance = view.map.distance_m[i];
        if (!(distance > 0)) continue;
        const PixelPlace at = strided_place(static_cast<std::int64_t>(i), view.map.width_px, view.map.stride);
        const Vec3d point = point_at(view.camera, {}, at, static_cast<double>(distance));
        if (taken.insert(cube_of(point, cube)).second) points.push_back(point);
      }
    }
  }
  return points;
}

// In metres.
std::vector<double> distances(const std::vector<Vec3d>& points, const NearestSurface& to, double metre) {
  std::vector<double> out(points.size());
  parallel_for((std::ssize(points) + kPiece - 1) / kPiece, [&](std::int64_t piece) {
    const auto end = std::min(points.size(), static_cast<std::size_t>((piece + 1) * kPiece));
    // Beyond the last distance that counts it is all the same.
    for (auto i = static_cast<std::size_t>(piece * kPiece); i < end; ++i)
      out[i] = to.distance(points[i], 2 * kScoreDistances.back() * metre) / metre;
  });
  return out;
}

ScoreShares shares_within(const std::vector<double>& distances) {
  ScoreShares shares{};
  for (std::size_t k = 0; k < shares.size(); ++k) {
    const auto near =
        std::count_if(distances.begin(), distances.end(), [&](double d) { return d <= kScoreDistances[k]; });
    shares[k] = distances.empty() ? 0 : static_cast<double>(near) / static_cast<double>(distances.size());
  }
  return shares;
}

// Strata of equal area, a point in each.
std::vector<Vec3d> drawn_from(const Surface& surface) {
  std::vector<double> until;  // area of the triangles up to and with each
  double sum = 0;
  for (const Triangle& t : surface.triangles) until.push_back(sum += area_of(surface, t));
  std::vector<Vec3d> points;
  for (std::int64_t i = 0; i < kMeshPoints && sum > 0; ++i) {
    const auto random = [&](std::int64_t k) {
      return static_cast<double>(uniform01(kOfMesh, static_cast<std::uint64_t>(3 * i + k)));
    };
    const double at = (static_cast<double>(i) + random(0)) / static_cast<double>(kMeshPoints) * sum;
    const auto found = std::min(std::upper_bound(until.begin(), until.end(), at), until.end() - 1);
    const Triangle& t = surface.triangles[static_cast<std::size_t>(found - until.begin())];
    const double root = std::sqrt(random(1)), of_c = random(2) * root;
    points.push_back(surface.positions[t[0]] * (1 - root) + surface.positions[t[1]] * (root - of_c) +
                     surface.positions[t[2]] * of_c);
  }
  return points;
}

// Whether the view measured something at the point's pixel that lies at most `behind` before the point.
bool speaks_of(const DepthView& view, Vec3d point, double behind) {
  const Vec3d p = view.camera.world_from_camera.apply_inverse(point);
  Camera camera = view.camera.camera;
  if (!view.camera.undistort) camera.k1 = camera.k2 = camera.k3 = camera.k4 = camera.p1 = camera.p2 = 0;
  if (!camera.sees(p) || !camera.is_within_lens(p)) return false;
  double u = 0, v = 0;
  camera.project(p, u, v);
  if (!(u >= 0 && v >= 0 && u < camera.width_px && v < camera.height_px)) return false;
  const auto distance = static_cast<double>(view.map.at(static_cast<std::int32_t>(u), static_cast<std::int32_t>(v)));
  return length(p) <= distance + behind;  // false for what is not a number
}

}  // namespace

DepthView measured_view(const RayCamera& camera, const DepthMap& depth) {
  const std::int32_t width = camera.camera.width_px, height = camera.camera.height_px;
  SEMFIELD_CHECK(depth.size() == static_cast<std::size_t>(std::int64_t{width} * height), "a value per pixel");
  DepthView view{camera, {1, width, height, {}, 0}};
  view.map.distance_m.resize(depth.size());
  parallel_for(height, [&](std::int64_t row) {
    for (std::int32_t column = 0; column < width; ++column) {
      const auto i = static_cast<std::size_t>(row * width + column);
      double origin[3], direction[3], near_far[2];
      const double cosine = cast_ray(camera, {}, column, static_cast<std::int32_t>(row), origin, direction, near_far);
      const double distance = static_cast<double>(depth[i]) / cosine;
      view.map.distance_m[i] = depth[i] > 0 && cosine > 0 ? static_cast<float>(distance) : kNotKnown;
    }
  });
  return view;
}

DepthReference::DepthReference(std::span<const DepthView> of_training, std::span<const DepthView> held_out,
                               double metre)
    : metre_(metre),
      training_views_(of_training),
      held_out_views_(held_out),
      points_(thinned({of_training, held_out}, kPointCube * metre)),
      held_out_(thinned({held_out}, kPointCube * metre)),
      measured_(points_) {}

bool DepthReference::judges(Vec3d point) const {
  const auto speaks = [&](const DepthView& view) { return speaks_of(view, point, kScoreDistances.back() * metre_); };
  return std::any_of(training_views_.begin(), training_views_.end(), speaks) ||
         std::any_of(held_out_views_.begin(), held_out_views_.end(), speaks);
}

MeshScore DepthReference::score(const Surface& surface) const {
  MeshScore score;
  const NearestSurface mesh(surface.positions, surface.triangles);
  score.complete = shares_within(distances(points_, mesh, metre_));
  if (!held_out_.empty()) score.complete_of_held_out = shares_within(distances(held_out_, mesh, metre_));

  const std::vector<Vec3d> drawn = drawn_from(surface);
  std::vector<char> is_judged(drawn.size());
  parallel_for((std::ssize(drawn) + kPiece - 1) / kPiece, [&](std::int64_t piece) {
    const auto end = std::min(drawn.size(), static_cast<std::size_t>((piece + 1) * kPiece));
    for (auto i = static_cast<std::size_t>(piece * kPiece); i < end; ++i) is_judged[i] = judges(drawn[i]) ? 1 : 0;
  });
  std::vector<Vec3d> judged;
  for (std::size_t i = 0; i < drawn.size(); ++i) {
    if (is_judged[i] != 0) judged.push_back(drawn[i]);
  }
  score.accurate = shares_within(distances(judged, measured_, metre_));
  score.judged = drawn.empty() ? 0 : static_cast<double>(judged.size()) / static_cast<double>(drawn.size());
  for (std::size_t k = 0; k < score.f.size(); ++k) {
    const double sum = score.complete[k] + score.accurate[k];
    score.f[k] = sum > 0 ? 2 * score.complete[k] * score.accurate[k] / sum : 0;
  }
  return score;
}

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
