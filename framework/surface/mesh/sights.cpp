#include "surface/mesh/sights.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield {

namespace {

constexpr std::int32_t kMostPixels = 512;  // a side of a depth image
constexpr double kBehindCells = 1.5;       // a vertex is still on the surface
constexpr double kLeastCosine = 0.05;      // between a normal and the way to the camera: three degrees
constexpr std::int64_t kCamerasAtOnce = 16;
constexpr double kBorder = 0.1;       // of a picture's sides, where it is trusted less and less
constexpr double kLeastTrust = 0.02;  // of a colour that is better than none
constexpr double kFarColor = 64;      // from the median, of 255
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

  // Where a vertex lies in the picture, in shares of its sides.
  std::array<double, 2> place(std::size_t vertex) const {
    return {static_cast<double>(vertices_[vertex].u) / camera_.width_px,
            static_cast<double>(vertices_[vertex].v) / camera_.height_px};
  }

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

// The colour of a photograph around (u, v), its pixels in shares of its sides; none where one that counts is masked or
// transparent.
std::optional<std::array<std::uint8_t, 3>> color_at(const StoredFrame& photo, double u, double v) {
  const double x = std::clamp(u * photo.width_px - 0.5, 0.0, photo.width_px - 1.0);
  const double y = std::clamp(v * photo.height_px - 0.5, 0.0, photo.height_px - 1.0);
  const auto left = static_cast<std::int32_t>(x), top = static_cast<std::int32_t>(y);
  std::array<double, 3> sum{0.5, 0.5, 0.5};
  for (std::int32_t k = 0; k < 4; ++k) {
    const std::int32_t column = left + k % 2, row = top + k / 2;
    const double share = (k % 2 == 1 ? x - left : 1 - x + left) * (k / 2 == 1 ? y - top : 1 - y + top);
    if (share == 0) continue;
    const auto at = static_cast<std::size_t>(std::int64_t{row} * photo.width_px + column);
    if (!photo.mask.uses(at) || (!photo.alpha.empty() && photo.alpha[at] != 255)) return std::nullopt;
    for (std::size_t c = 0; c < 3; ++c) sum[c] += share * photo.rgb[3 * at + c];
  }
  std::array<std::uint8_t, 3> color{};
  for (std::size_t c = 0; c < 3; ++c) color[c] = static_cast<std::uint8_t>(sum[c]);
  return color;
}

// A vertex in a camera's picture.
struct Shown {
  std::uint32_t vertex;
  float area;   // pixels of the camera per area of the surface
  float trust;  // of the colour; 0: none
  std::array<std::uint8_t, 3> color;
};

// The vertices that a camera sees.
std::vector<Shown> shown_by(const RayCamera& view, const StoredFrame* photo, const Surface& surface,
                            const RayLimits& limits, double cell) {
  const DepthImage image(surface, view, limits);
  std::vector<Shown> shown;
  for (std::uint32_t i = 0; i < surface.positions.size(); ++i) {
    const Vec3d way = view.world_from_camera.t - surface.positions[i];
    const double distance = length(way), cosine = dot(surface.normals[i], way) / distance;
    if (!(cosine > kLeastCosine) || !image.shows(i, kBehindCells * cell)) continue;
    Shown one{i, static_cast<float>(view.camera.fx * view.camera.fy * cosine / (distance * distance)), 0, {}};
    if (photo != nullptr && !photo->rgb.empty()) {
      const auto [u, v] = image.place(i);
      if (const auto color = color_at(*photo, u, v)) {
        const double border = std::clamp(std::min({u, v, 1 - u, 1 - v}) / kBorder, kLeastTrust, 1.0);
        one.trust = static_cast<float>(border);
        one.color = *color;
      }
    }
    shown.push_back(one);
  }
  return shown;
}

// Keeps the best, best first.
template <class What, std::size_t kCount>
void take(std::array<float, kCount>& weights, std::array<What, kCount>& best, float weight, What what) {
  for (std::size_t k = 0; k < kCount; ++k) {
    if (!(weight > weights[k])) continue;
    std::swap(weight, weights[k]);
    std::swap(what, best[k]);
  }
}

// The best looks at a vertex.
struct BestLooks {
  static constexpr std::size_t kMost = 8;
  std::array<float, kMost> weight{};
  std::array<std::array<std::uint8_t, 3>, kMost> color{};

  // Their mean, without those far from the weighted median.
  std::array<std::uint8_t, 3> mean() const {
    std::array<double, 3> median{}, sum{};
    double all = 0, near = 0;
    for (const float w : weight) all += static_cast<double>(w);
    for (std::size_t c = 0; c < 3; ++c) {
      std::array<std::pair<std::uint8_t, float>, kMost> values;
      for (std::size_t k = 0; k < kMost; ++k) values[k] = {color[k][c], weight[k]};
      std::sort(values.begin(), values.end());
      double below = 0;
      for (const auto& [value, w] : values) {
        below += static_cast<double>(w);
        median[c] = value;
        if (2 * below >= all) break;
      }
    }
    for (std::size_t k = 0; k < kMost; ++k) {
      double off = 0;
      for (std::size_t c = 0; c < 3; ++c) off = std::max(off, std::abs(median[c] - color[k][c]) / kFarColor);
      const double weighs = static_cast<double>(weight[k]) * std::max(kLeastTrust, 1 - off * off);
      near += weighs;
      for (std::size_t c = 0; c < 3; ++c) sum[c] += weighs * color[k][c];
    }
    std::array<std::uint8_t, 3> out{};
    for (std::size_t c = 0; c < 3; ++c) out[c] = static_cast<std::uint8_t>(std::lround(sum[c] / near));
    return out;
  }
};

}  // namespace

std::vector<Sights> sights_of(const Surface& surface, std::span<const RayCamera> cameras, const RayLimits& limits,
                              double cell, PhotoColors* colors) {
  SEMFIELD_CHECK(surface.normals.size() == surface.positions.size(), "a normal per vertex");
  std::vector<Sights> sights(surface.positions.size());
  std::vector<BestLooks> looks(colors != nullptr ? sights.size() : 0);
  for (std::int64_t begin = 0; begin < std::ssize(cameras); begin += kCamerasAtOnce) {
    const std::int64_t count = std::min(kCamerasAtOnce, std::ssize(cameras) - begin);
    std::vector<std::vector<Shown>> shown(static_cast<std::size_t>(count));
    parallel_for(count, [&](std::int64_t c) {
      const auto camera = static_cast<std::size_t>(begin + c);
      shown[static_cast<std::size_t>(c)] =
          shown_by(cameras[camera], colors != nullptr ? colors->photos[camera] : nullptr, surface, limits, cell);
    });
    for (std::int64_t c = 0; c < count; ++c) {
      for (const Shown& one : shown[static_cast<std::size_t>(c)]) {
        Sights& best = sights[one.vertex];
        take(best.weight, best.camera, one.area, static_cast<std::int32_t>(begin + c));
        if (colors == nullptr) continue;
        BestLooks& look = looks[one.vertex];
        take(look.weight, look.color, one.trust * one.area, one.color);
      }
    }
  }
  if (colors != nullptr) {
    colors->color.assign(looks.size(), {128, 128, 128});
    colors->known.assign(looks.size(), 0);
    for (std::size_t v = 0; v < looks.size(); ++v) {
      if (looks[v].weight[0] == 0) continue;
      colors->color[v] = looks[v].mean();
      colors->known[v] = 1;
    }
  }
  return sights;
}

std::vector<char> triangles_in_sight(const Surface& surface, std::span<const Sights> sights) {
  std::vector<char> seen(sights.size());
  for (std::size_t v = 0; v < seen.size(); ++v) seen[v] = sights[v].any() ? 1 : 0;
  const Edges edges = edges_of(surface);
  // A morphological closing: what is far from everything seen grows back to the rim of what is seen.
  seen = grown(edges, grown(edges, std::move(seen), kGapRings), -kGapRings);

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

}  // namespace semfield
