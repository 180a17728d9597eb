#include "surface/mesh/sights.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield {

namespace {

constexpr std::int32_t kMostPixels = 512;    // a side of a depth image
constexpr double kBehindCells = 1.5;         // a vertex is still on the surface
constexpr double kLeastCosine = 0.05;        // between a normal and the way to the camera: three degrees
constexpr std::int64_t kCamerasAtOnce = 16;  // each has a number per vertex in memory
constexpr float kNothing = std::numeric_limits<float>::infinity();

// A vertex as a camera sees it: image point in pixels and depth; depth 0 where there is none.
struct Projected {
  float u = 0, v = 0, z = 0;
};

// Distance along the ray, or z-depth, whichever near and far are.
double range_of(const Camera& camera, Vec3d in_camera, const RayLimits& limits) {
  return limits.z_depth ? camera.depth_of(in_camera) : length(in_camera);
}

Camera small(const Camera& camera) {
  const std::int32_t longest = std::max(camera.width_px, camera.height_px);
  if (longest <= kMostPixels) return camera;
  const auto scaled = [&](std::int32_t side) {
    return std::max(1, static_cast<std::int32_t>(std::int64_t{side} * kMostPixels / longest));
  };
  return camera.resized(scaled(camera.width_px), scaled(camera.height_px));
}

// Nearest triangle of every pixel.
class DepthImage {
 public:
  DepthImage(const Surface& surface, const RayCamera& view, const RayLimits& limits)
      : camera_(small(view.camera)), depth_(static_cast<std::size_t>(camera_.width_px) * height(), kNothing) {
    if (!view.undistort) camera_.k1 = camera_.k2 = camera_.k3 = camera_.k4 = camera_.p1 = camera_.p2 = 0;
    vertices_.resize(surface.positions.size());
    for (std::size_t i = 0; i < vertices_.size(); ++i) {
      const Vec3d p = view.world_from_camera.apply_inverse(surface.positions[i]);
      const double range = range_of(camera_, p, limits);
      if (!camera_.sees(p) || range < limits.near_m || range > limits.far_m || !camera_.is_within_lens(p)) continue;
      double u = 0, v = 0;
      camera_.project(p, u, v);
      vertices_[i] = {static_cast<float>(u), static_cast<float>(v), static_cast<float>(camera_.depth_of(p))};
    }
    for (const Triangle& t : surface.triangles) draw(vertices_[t[0]], vertices_[t[1]], vertices_[t[2]]);
  }

  const Camera& camera() const { return camera_; }

  // Whether a vertex is at most `behind` further away than what its pixel shows. Of the four pixels around it, the
  // farthest counts: a surface that is seen along itself changes its depth within one.
  bool shows(std::size_t vertex, double behind) const {
    const Projected& p = vertices_[vertex];
    if (p.z == 0 || !(p.u >= 0 && p.v >= 0 && p.u < static_cast<float>(camera_.width_px) &&
                      p.v < static_cast<float>(camera_.height_px)))
      return false;
    const auto column = static_cast<std::int32_t>(std::floor(p.u - 0.5F)),
               row = static_cast<std::int32_t>(std::floor(p.v - 0.5F));
    float farthest = 0;
    for (std::int32_t y = std::max(0, row); y <= std::min(camera_.height_px - 1, row + 1); ++y) {
      for (std::int32_t x = std::max(0, column); x <= std::min(camera_.width_px - 1, column + 1); ++x) {
        const float z = depth_[at(x, y)];
        if (z != kNothing) farthest = std::max(farthest, z);
      }
    }
    return static_cast<double>(p.z) <= static_cast<double>(farthest) + behind;
  }

 private:
  std::size_t height() const { return static_cast<std::size_t>(camera_.height_px); }
  std::size_t at(std::int32_t x, std::int32_t y) const {
    return static_cast<std::size_t>(y) * static_cast<std::size_t>(camera_.width_px) + static_cast<std::size_t>(x);
  }

  // Into the pixels whose centres it covers, and into those of its corners: a small triangle misses every centre.
  void draw(const Projected& a, const Projected& b, const Projected& c) {
    if (a.z == 0 || b.z == 0 || c.z == 0) return;
    const float left = std::min({a.u, b.u, c.u}), right = std::max({a.u, b.u, c.u});
    const float top = std::min({a.v, b.v, c.v}), bottom = std::max({a.v, b.v, c.v});
    const auto width = static_cast<float>(camera_.width_px), height = static_cast<float>(camera_.height_px);
    // A panorama shows a triangle across its seam at both ends, and nowhere between.
    if (camera_.lens == LensKind::equirectangular && right - left > 0.5F * width) return;
    if (!(right >= 0 && bottom >= 0 && left < width && top < height)) return;
    for (const Projected* p : {&a, &b, &c}) {
      if (p->u >= 0 && p->v >= 0 && p->u < width && p->v < height)
        meet(static_cast<std::int32_t>(p->u), static_cast<std::int32_t>(p->v), p->z);
    }
    const float area = (b.u - a.u) * (c.v - a.v) - (b.v - a.v) * (c.u - a.u);
    if (area == 0) return;
    const auto first = [](float from) { return static_cast<std::int32_t>(std::ceil(std::max(0.0F, from - 0.5F))); };
    const auto last = [](float to, std::int32_t side) {
      return std::min(side - 1, static_cast<std::int32_t>(std::floor(to - 0.5F)));
    };
    for (std::int32_t y = first(top); y <= last(bottom, camera_.height_px); ++y) {
      for (std::int32_t x = first(left); x <= last(right, camera_.width_px); ++x) {
        const float u = static_cast<float>(x) + 0.5F, v = static_cast<float>(y) + 0.5F;
        const float of_b = ((u - a.u) * (c.v - a.v) - (v - a.v) * (c.u - a.u)) / area;
        const float of_c = ((b.u - a.u) * (v - a.v) - (b.v - a.v) * (u - a.u)) / area;
        if (of_b < 0 || of_c < 0 || of_b + of_c > 1) continue;
        // Along a triangle 1 / z is linear in the image.
        meet(x, y, 1 / ((1 - of_b - of_c) / a.z + of_b / b.z + of_c / c.z));
      }
    }
  }
  void meet(std::int32_t x, std::int32_t y, float z) {
    float& nearest = depth_[at(x, y)];
    nearest = std::min(nearest, z);
  }

  Camera camera_;
  std::vector<float> depth_;
  std::vector<Projected> vertices_;
};

// Pixels of the camera per area of the surface at each vertex; 0 where the camera does not see it.
std::vector<float> shown_by(const RayCamera& view, const Surface& surface, const RayLimits& limits, double cell) {
  const DepthImage image(surface, view, limits);
  std::vector<float> shown(surface.positions.size());
  for (std::size_t i = 0; i < shown.size(); ++i) {
    const Vec3d way = view.world_from_camera.t - surface.positions[i];
    const double distance = length(way), cosine = dot(surface.normals[i], way) / distance;
    if (!(cosine > kLeastCosine) || !image.shows(i, kBehindCells * cell)) continue;
    shown[i] = static_cast<float>(view.camera.fx * view.camera.fy * cosine / (distance * distance));
  }
  return shown;
}

void take(Sights& sights, std::int32_t camera, float weight) {
  for (std::size_t k = 0; k < Sights::kMost; ++k) {
    if (!(weight > sights.weight[k])) continue;
    std::swap(weight, sights.weight[k]);
    std::swap(camera, sights.camera[k]);
  }
}

// Edges between vertices, both ways: those of vertex v are to[first[v]] ... to[first[v + 1] - 1].
struct Edges {
  std::vector<std::uint32_t> first, to;
};
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

// Whether at most `rings` edges lead to each vertex from one where `start` is set.
std::vector<char> grown(const Edges& edges, std::vector<char> start, int rings) {
  std::vector<std::uint32_t> rim, next;
  for (std::uint32_t v = 0; v < start.size(); ++v) {
    if (start[v] != 0) rim.push_back(v);
  }
  for (int ring = 0; ring < rings; ++ring) {
    next.clear();
    for (const std::uint32_t v : rim) {
      for (std::uint32_t e = edges.first[v]; e < edges.first[v + 1]; ++e) {
        if (start[edges.to[e]] != 0) continue;
        start[edges.to[e]] = 1;
        next.push_back(edges.to[e]);
      }
    }
    rim.swap(next);
  }
  return start;
}

}  // namespace

std::vector<Sights> sights_of(const Surface& surface, std::span<const RayCamera> cameras, const RayLimits& limits,
                              double cell) {
  SEMFIELD_CHECK(surface.normals.size() == surface.positions.size(), "a normal per vertex");
  std::vector<Sights> sights(surface.positions.size());
  for (std::int64_t begin = 0; begin < std::ssize(cameras); begin += kCamerasAtOnce) {
    const std::int64_t count = std::min(kCamerasAtOnce, std::ssize(cameras) - begin);
    std::vector<std::vector<float>> shown(static_cast<std::size_t>(count));
    parallel_for(count, [&](std::int64_t c) {
      shown[static_cast<std::size_t>(c)] =
          shown_by(cameras[static_cast<std::size_t>(begin + c)], surface, limits, cell);
    });
    for (std::size_t v = 0; v < sights.size(); ++v) {
      for (std::int64_t c = 0; c < count; ++c)
        take(sights[v], static_cast<std::int32_t>(begin + c), shown[static_cast<std::size_t>(c)][v]);
    }
  }
  return sights;
}

std::vector<char> triangles_in_sight(const Surface& surface, std::span<const Sights> sights) {
  std::vector<char> seen(sights.size());
  for (std::size_t v = 0; v < seen.size(); ++v) seen[v] = sights[v].any() ? 1 : 0;
  const Edges edges = edges_of(surface);
  // A morphological closing: what is far from everything seen grows back to the rim of what is seen.
  std::vector<char> lost = grown(edges, seen, kGapRings);
  for (char& v : lost) v = v == 0 ? 1 : 0;
  lost = grown(edges, lost, kGapRings);
  for (std::size_t v = 0; v < seen.size(); ++v) seen[v] = seen[v] != 0 || lost[v] == 0 ? 1 : 0;

  const Components parts = components_of(surface);
  std::vector<double> area(parts.faces.size()), hidden(parts.faces.size());
  std::vector<char> keep(surface.triangles.size());
  for (std::size_t i = 0; i < keep.size(); ++i) {
    const Triangle& t = surface.triangles[i];
    keep[i] = seen[t[0]] != 0 && seen[t[1]] != 0 && seen[t[2]] != 0 ? 1 : 0;
    const double size = area_of(surface, t);
    area[parts.of_vertex[t[0]]] += size;
    if (keep[i] == 0) hidden[parts.of_vertex[t[0]]] += size;
  }
  for (std::size_t i = 0; i < keep.size(); ++i) {
    const std::uint32_t part = parts.of_vertex[surface.triangles[i][0]];
    if (hidden[part] <= kHiddenShare * area[part]) keep[i] = 1;
  }
  return keep;
}

void lend_sights(const Surface& surface, std::span<Sights> sights) {
  const Edges edges = edges_of(surface);
  std::vector<std::uint32_t> reached;
  for (std::uint32_t v = 0; v < sights.size(); ++v) {
    if (sights[v].any()) reached.push_back(v);
  }
  for (std::size_t at = 0; at < reached.size(); ++at) {
    const std::uint32_t v = reached[at];
    for (std::uint32_t e = edges.first[v]; e < edges.first[v + 1]; ++e) {
      Sights& other = sights[edges.to[e]];
      if (other.any()) continue;
      other = sights[v];
      other.lent = true;
      reached.push_back(edges.to[e]);
    }
  }
}

Looks looks_at(Vec3d point, Vec3d normal, const Sights& sights, std::span<const RayCamera> cameras) {
  Looks looks;
  double sum = 0;
  for (std::size_t k = 0; k < Sights::kMost && sights.camera[k] >= 0; ++k) {
    const Vec3d way = point - cameras[static_cast<std::size_t>(sights.camera[k])].world_from_camera.t;
    if (!(dot(way, normal) < 0)) continue;
    looks.direction[looks.count] = normalized(way);
    looks.eye[looks.count] = sights.lent ? -1 : sights.camera[k];
    looks.weight[looks.count] = static_cast<double>(sights.weight[k]);
    sum += looks.weight[looks.count++];
  }
  if (looks.count == 0) {
    looks.direction[0] = normal * -1.0;
    looks.eye[0] = -1;
    looks.weight[0] = sum = 1;
    looks.count = 1;
  }
  for (double& weight : looks.weight) weight /= sum;
  return looks;
}

}  // namespace semfield
