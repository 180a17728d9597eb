#include "handover/splat_colors.h"

#include <algorithm>
#include <bit>
#include <cmath>

#include "compute/parallel.h"

namespace semfield {

namespace {

constexpr double kLowPass = 0.3;  // square pixels that viewers widen every footprint by [Kerbl23]
constexpr double kNear = 8;   // deviations, before which a splat is no ellipse on the image; viewers draw it late too
constexpr double kReach = 3;  // deviations that a footprint reaches
constexpr float kLeastAlpha = 1.0F / 255, kMostPower = 11.1F;  // exp(-kMostPower / 2) is less
constexpr float kLeastLeft = 1e-3F;  // of a pixel's light, that something behind still counts for
constexpr std::int64_t kSplatsAtOnce = 1 << 14;
constexpr std::int32_t kBandRows = 8;
constexpr int kSteps = 3;
constexpr double kRelaxed = 1.8;  // of a step; below 2 they converge

// A Gaussian on the image: exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2).
struct Footprint {
  float depth;
  std::uint32_t splat;
  float u, v, a, b, c;
  std::int32_t left, right, top, bottom;  // pixels, the last ones included
};

// What a splat gives to a pixel.
struct Share {
  std::uint32_t splat, pixel;
  float weight;
};

struct Drawing {
  std::vector<std::vector<Share>> bands;  // of rows, each from front to back
  std::vector<float> left;                // of each pixel's light
};

// The covariance on the image is J V J^T with the Jacobian J of a pinhole's projection [Zwicker01]; of the same
// deviation along all axes, V is a multiple of 1.
bool footprint(const RayCamera& camera, Vec3d place, double deviation, Footprint& out) {
  const Camera& lens = camera.camera;
  const Vec3d p = camera.world_from_camera.apply_inverse(place);
  if (p.z < kNear * deviation || !lens.is_within_lens(p)) return false;
  double u = lens.fx * p.x / p.z + lens.cx, v = lens.fy * p.y / p.z + lens.cy;
  if (camera.undistort) lens.project(p, u, v);
  const double x = p.x / p.z, y = p.y / p.z, sx = lens.fx * deviation / p.z, sy = lens.fy * deviation / p.z;
  const double a = sx * sx * (1 + x * x) + kLowPass, b = sx * sy * x * y, c = sy * sy * (1 + y * y) + kLowPass;
  const double det = a * c - b * b, half = 0.5 * (a - c);
  const double radius = kReach * std::sqrt(0.5 * (a + c) + std::sqrt(half * half + b * b));
  if (!(u + radius > 0 && u - radius < lens.width_px && v + radius > 0 && v - radius < lens.height_px)) return false;
  const auto pixel = [](double at, std::int32_t count) {
    return static_cast<std::int32_t>(std::clamp(std::floor(at), 0.0, count - 1.0));
  };
  out = {static_cast<float>(p.z),
         out.splat,
         static_cast<float>(u),
         static_cast<float>(v),
         static_cast<float>(c / det),
         static_cast<float>(-b / det),
         static_cast<float>(a / det),
         pixel(u - radius, lens.width_px),
         pixel(u + radius, lens.width_px),
         pixel(v - radius, lens.height_px),
         pixel(v + radius, lens.height_px)};
  return true;
}

// In the order of the splats.
std::vector<Footprint> footprints(const Splats& splats, const RayCamera& camera) {
  const std::int64_t count = std::ssize(splats.points.positions);
  std::vector<std::vector<Footprint>> parts(static_cast<std::size_t>((count + kSplatsAtOnce - 1) / kSplatsAtOnce));
  parallel_for(std::ssize(parts), [&](std::int64_t part) {
    const std::int64_t end = std::min(count, (part + 1) * kSplatsAtOnce);
    for (std::int64_t i = part * kSplatsAtOnce; i < end; ++i) {
      Footprint one{};
      one.splat = static_cast<std::uint32_t>(i);
      if (footprint(camera, splats.points.positions[static_cast<std::size_t>(i)], splats.deviation, one))
        parts[static_cast<std::size_t>(part)].push_back(one);
    }
  });
  std::vector<Footprint> all;
  for (const std::vector<Footprint>& part : parts) all.insert(all.end(), part.begin(), part.end());
  return all;
}

Drawing drawing(const Splats& splats, const RayCamera& camera) {
  const std::int32_t width = camera.camera.width_px, height = camera.camera.height_px;
  const std::vector<Footprint> seen = footprints(splats, camera);
  Drawing out;
  out.bands.resize(static_cast<std::size_t>((height + kBandRows - 1) / kBandRows));
  std::vector<std::vector<std::uint64_t>> reach(out.bands.size());  // depth, and place in `seen`, in each band
  for (std::size_t i = 0; i < seen.size(); ++i)
    for (std::int32_t band = seen[i].top / kBandRows; band <= seen[i].bottom / kBandRows; ++band)
      reach[static_cast<std::size_t>(band)].push_back(std::uint64_t{std::bit_cast<std::uint32_t>(seen[i].depth)} << 32 |
                                                      i);
  out.left.assign(static_cast<std::size_t>(width) * static_cast<std::size_t>(height), 1);
  parallel_for(std::ssize(out.bands), [&](std::int64_t band) {
    const auto first = static_cast<std::int32_t>(band) * kBandRows;
    const std::int32_t last = std::min(first + kBandRows, height) - 1;
    std::vector<std::uint64_t>& order = reach[static_cast<std::size_t>(band)];
    std::sort(order.begin(), order.end());  // bits of numbers above 0 are in the order of the numbers
    for (const std::uint64_t key : order) {
      const Footprint& one = seen[static_cast<std::uint32_t>(key)];
      for (std::int32_t row = std::max(first, one.top); row <= std::min(last, one.bottom); ++row) {
        for (std::int32_t column = one.left; column <= one.right; ++column) {
          const auto pixel = static_cast<std::uint32_t>(row * width + column);
          float& left = out.left[pixel];
          if (left < kLeastLeft) continue;
          const float dx = static_cast<float>(column) + 0.5F - one.u, dy = static_cast<float>(row) + 0.5F - one.v;
          const float power = one.a * dx * dx + 2 * one.b * dx * dy + one.c * dy * dy;
          if (power > kMostPower) continue;
          const float alpha = splats.opacity[one.splat] * std::exp(-0.5F * power);
          if (alpha < kLeastAlpha) continue;
          out.bands[static_cast<std::size_t>(band)].push_back({one.splat, pixel, left * alpha});
          left *= 1 - alpha;
        }
      }
    }
  });
  return out;
}

// `color` [N, 3].
std::vector<float> composed(const Drawing& drawn, std::span<const float> color,
                            const std::array<double, 3>& background) {
  std::vector<float> rgb(3 * drawn.left.size());
  for (std::size_t pixel = 0; pixel < drawn.left.size(); ++pixel)
    for (std::size_t k = 0; k < 3; ++k) rgb[3 * pixel + k] = drawn.left[pixel] * static_cast<float>(background[k]);
  for (const std::vector<Share>& band : drawn.bands)
    for (const Share& share : band)
      for (std::size_t k = 0; k < 3; ++k) rgb[3 * share.pixel + k] += share.weight * color[3 * share.splat + k];
  return rgb;
}

std::vector<float> colors_of(const Splats& splats) {
  std::vector<float> color;
  color.reserve(3 * splats.points.positions.size());
  for (const std::array<std::uint8_t, 3>& one : splats.points.attributes.color)
    for (const std::uint8_t c : one) color.push_back(static_cast<float>(c) / 255);
  return color;
}

}  // namespace

std::vector<float> draw_splats(const Splats& splats, const RayCamera& camera, const std::array<double, 3>& background) {
  if (camera.camera.is_wide()) return {};
  return composed(drawing(splats, camera), colors_of(splats), background);
}

void fit_colors(Splats& splats, std::span<const SplatView> views, const std::array<double, 3>& background) {
  std::vector<float> color = colors_of(splats), missed(color.size()), weight(color.size() / 3);
  for (int step = 0; step < kSteps; ++step) {
    std::fill(missed.begin(), missed.end(), 0.0F);
    std::fill(weight.begin(), weight.end(), 0.0F);
    for (const SplatView& view : views) {
      if (view.camera.camera.is_wide()) continue;
      const Drawing drawn = drawing(splats, view.camera);
      const std::vector<float> rgb = composed(drawn, color, background);
      for (const std::vector<Share>& band : drawn.bands) {
        for (const Share& share : band) {
          weight[share.splat] += share.weight;
          for (std::size_t k = 0; k < 3; ++k) {
            const std::size_t at = 3 * share.pixel + k;
            missed[3 * share.splat + k] += share.weight * (static_cast<float>(view.rgb[at]) / 255 - rgb[at]);
          }
        }
      }
    }
    for (std::size_t i = 0; i < color.size(); ++i)
      if (weight[i / 3] > 0)
        color[i] = std::clamp(color[i] + static_cast<float>(kRelaxed) * missed[i] / weight[i / 3], 0.0F, 1.0F);
  }
  for (std::size_t i = 0; i < weight.size(); ++i)
    for (std::size_t k = 0; k < 3; ++k)
      splats.points.attributes.color[i][k] = static_cast<std::uint8_t>(std::lround(255 * color[3 * i + k]));
}

}  // namespace semfield
