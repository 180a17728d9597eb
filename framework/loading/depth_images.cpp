#include "loading/depth_images.h"

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <limits>

#include "core/check.h"
#include "core/error.h"
#include "formats/npz.h"
#include "formats/text_rows.h"

namespace semfield {

namespace {

std::string ending_of(const std::string& path) {
  std::string out = std::filesystem::path(path).extension().string();
  for (char& c : out) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return out;
}

// [height, width] of the array, whose other axes have one place.
std::vector<std::int64_t> plane_of(std::span<const std::int64_t> shape) {
  std::vector<std::int64_t> plane;
  for (const std::int64_t axis : shape)
    if (axis != 1 || shape.size() == 2) plane.push_back(axis);
  if (plane.size() != 2)
    throw Error(ErrorKind::data, "scene.depth.shape", "the shape is " + shape_text(shape),
                "save depth as an array [height, width]");
  check_image_limits(plane[1], plane[0], 1, sizeof(float));
  return plane;
}

Image<float> read_depth_array(const std::string& path, double unit_m) {
  const NumpyValues array = read_npy_values(path, [](std::span<const std::int64_t> shape) { (void)plane_of(shape); });
  const std::vector<std::int64_t> plane = plane_of(array.shape);
  Image<float> out{static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, {}};
  out.pixels.reserve(array.values.size());
  const double ceiling = array.is_whole && array.element_bytes == 2 ? 65535 : std::numeric_limits<float>::max();
  for (const double value : array.values)
    out.pixels.push_back(value > 0 && value < ceiling ? static_cast<float>(value * (array.is_whole ? unit_m : 1)) : 0);
  return out;
}

}  // namespace

// A TIFF holds integers or real numbers, which have 32 bits.
bool has_real_depth(const std::string& path) {
  const std::string ending = ending_of(path);
  if (ending == ".npy") return !npy_is_whole(path);
  if (ending == ".tif" || ending == ".tiff") return image_size(path).bits > 16;
  return ending == ".exr" || ending == ".pfm";
}

ImageSize depth_size(const std::string& path) {
  if (ending_of(path) != ".npy") return image_size(path);
  try {
    const std::vector<std::int64_t> plane = plane_of(npy_shape(path));
    return {static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, 32};
  } catch (const Error& e) {
    if (e.message().find(path) != std::string::npos) throw;
    throw Error(e.kind(), e.code(), "'" + path + "': " + e.message(), e.remedy());
  }
}

Image<float> read_depth(const std::string& path, double unit_m) {
  if (ending_of(path) == ".npy") return read_depth_array(path, unit_m);
  if (has_real_depth(path)) {
    Image<float> out = read_float(path);
    for (float& d : out.pixels)
      if (!std::isfinite(d) || d < 0) d = 0;
    return out;
  }
  const Image<std::uint16_t> image = read_ids(path);
  Image<float> out{image.width_px, image.height_px, 1, std::vector<float>(image.pixels.size())};
  for (std::size_t i = 0; i < out.pixels.size(); ++i)
    out.pixels[i] = image.pixels[i] == 65535 ? 0.0f : static_cast<float>(image.pixels[i] * unit_m);
  return out;
}

std::vector<float> at_nearest_pixels(const Image<float>& image, std::int32_t width, std::int32_t height) {
  const auto rows = nearest_pixels(image.height_px, height), cols = nearest_pixels(image.width_px, width);
  std::vector<float> out;
  out.reserve(rows.size() * cols.size());
  for (const std::int64_t row : rows) {
    const float* const line = image.pixels.data() + row * image.width_px;
    for (const std::int64_t col : cols) out.push_back(line[col]);
  }
  return out;
}

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
