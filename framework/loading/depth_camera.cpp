#include "loading/depth_camera.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "core/check.h"

namespace semfield {

namespace {

constexpr double kEdge = 0.04;    // relative step of depth between neighbours
constexpr double kWidest = 1000;  // pixels of the colour image that a facet covers at most: beyond, the lens folds

struct Corner {
  double u = 0, v = 0, depth = 0;  // in the colour image; depth 0: not seen there
  double taken = 0;                // as the depth camera took it
};

class Canvas {
 public:
  Canvas(const Camera& camera) : width_(camera.width_px), height_(camera.height_px) {
    depth_.resize(static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_));
  }
  // Pixel centres within the triangle; inverse depth is linear in the image of a pinhole.
  void triangle(const Corner& a, const Corner& b, const Corner& c) {
    const double least = std::min({a.taken, b.taken, c.taken}), most = std::max({a.taken, b.taken, c.taken});
    if (!(least > 0) || !(a.depth > 0) || !(b.depth > 0) || !(c.depth > 0) || most - least > kEdge * least) return;
    const double area = (b.u - a.u) * (c.v - a.v) - (c.u - a.u) * (b.v - a.v);
    const double u0 = std::min({a.u, b.u, c.u}), u1 = std::max({a.u, b.u, c.u});
    const double v0 = std::min({a.v, b.v, c.v}), v1 = std::max({a.v, b.v, c.v});
    if (area == 0 || !(u1 - u0 < kWidest) || !(v1 - v0 < kWidest)) return;
    const auto first = [](double at) { return std::max(0.0, std::ceil(at - 0.5)); };
    const auto last = [](double at, std::int32_t size) { return std::min(size - 1.0, std::floor(at - 0.5)); };
    for (double y = first(v0); y <= last(v1, height_); ++y) {
      for (double x = first(u0); x <= last(u1, width_); ++x) {
        const double u = x + 0.5, v = y + 0.5;
        const double wb = ((u - a.u) * (c.v - a.v) - (c.u - a.u) * (v - a.v)) / area;
        const double wc = ((b.u - a.u) * (v - a.v) - (u - a.u) * (b.v - a.v)) / area;
        if (wb < -1e-9 || wc < -1e-9 || wb + wc > 1 + 1e-9) continue;
        const double at = 1 / ((1 - wb - wc) / a.depth + wb / b.depth + wc / c.depth);
        float& here =
            depth_[static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x)];
        if (here == 0 || at < static_cast<double>(here)) here = static_cast<float>(at);
      }
    }
  }
  std::vector<float> take() { return std::move(depth_); }

 private:
  std::int32_t width_, height_;
  std::vector<float> depth_;
};

}  // namespace

std::vector<float> drawn_depth(const Image<float>& depth, const DepthCamera& from, const Camera& color) {
  SEMFIELD_CHECK(depth.width_px == from.camera.width_px && depth.height_px == from.camera.height_px,
                 "the depth image has another size than its camera");
  const auto corner = [&](std::int32_t x, std::int32_t y) {
    Corner out;
    const auto taken =
        static_cast<double>(depth.pixels[static_cast<std::size_t>(y) * static_cast<std::size_t>(depth.width_px) +
                                         static_cast<std::size_t>(x)]);
    const Vec3d ray = from.camera.direction(x + 0.5, y + 0.5);
    const double per_distance = from.camera.depth_of(ray);
    if (!(taken > 0) || !(per_distance > 0)) return out;
    const Vec3d p = from.depth_from_color.apply_inverse(ray * (taken / per_distance));
    if (!color.sees(p) || !color.is_within_lens(p)) return out;
    color.project(p, out.u, out.v);
    out.depth = color.depth_of(p);
    out.taken = taken;
    return out;
  };
  Canvas canvas(color);
  std::vector<Corner> above, row;
  for (std::int32_t y = 0; y < depth.height_px; ++y) {
    row.clear();
    for (std::int32_t x = 0; x < depth.width_px; ++x) row.push_back(corner(x, y));
    for (std::size_t x = 0; y > 0 && x + 1 < row.size(); ++x) {
      const std::array<const Corner*, 4> quad{&above[x], &above[x + 1], &row[x + 1], &row[x]};
      // Along the diagonal whose ends are nearer to each other in depth; with a corner missing, what is left.
      const bool falling = std::abs(quad[0]->taken - quad[2]->taken) <= std::abs(quad[1]->taken - quad[3]->taken);
      const std::size_t turn =
          (quad[1]->taken > 0 && quad[3]->taken > 0 && (!falling || quad[0]->taken == 0 || quad[2]->taken == 0)) ? 1
                                                                                                                 : 0;
      const auto at = [&](std::size_t k) -> const Corner& { return *quad[(k + turn) % 4]; };
      canvas.triangle(at(0), at(1), at(2));
      canvas.triangle(at(0), at(2), at(3));
    }
    above.swap(row);
  }
  return canvas.take();
}

}  // namespace semfield
