#include "handover/splats.h"

#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "core/error.h"

namespace semfield {

namespace {

constexpr std::int64_t kPointsAtOnce = 1 << 16;
constexpr std::int32_t kRowsAtOnce = 64;
constexpr double kStep = 0.7;         // of an edge, along a ray
constexpr float kLeastShare = 1e-3F;  // of a pixel's light, that counts for a cube
constexpr float kLeastLight = 0.3F;   // pixels of all views, that end in a cube that is written
constexpr float kSolid = 5;           // optical depth of a cube that nothing passes

// Li2(a) = sum of a^k / k^2; the series is short enough below kMostOpacity.
double dilogarithm(double a) {
  double sum = 0, power = 1;
  for (int k = 1; k < 600; ++k) {
    power *= a;
    sum += power / (static_cast<double>(k) * k);
  }
  return sum;
}

}  // namespace

double splat_opacity(double optical_depth, double width) {
  static const std::vector<double> table = [] {
    std::vector<double> values;
    for (int i = 0; i <= 1000; ++i) values.push_back(dilogarithm(kMostOpacity * i / 1000.0));
    return values;
  }();
  const double wanted = optical_depth / (2 * std::acos(-1.0) * width * width);
  const auto above = std::lower_bound(table.begin(), table.end(), wanted);
  if (above == table.end()) return kMostOpacity;
  if (above == table.begin()) return 0;
  const double share = (wanted - above[-1]) / (above[0] - above[-1]);
  return kMostOpacity * (static_cast<double>(above - table.begin() - 1) + share) / 1000;
}

SplatVolume::SplatVolume(const Pipeline<float>& pipeline, const VoxelGridPlace& place, const Box& bounds, bool opaque)
    : place_(place), density_(place.cells()), number_(place.cells(), -1) {
  std::vector<double> position(static_cast<std::size_t>(3 * kPointsAtOnce));
  const auto cells = static_cast<std::int64_t>(place.cells());
  for (std::int64_t begin = 0; begin < cells; begin += kPointsAtOnce) {
    const std::int64_t count = std::min(kPointsAtOnce, cells - begin);
    for (std::int64_t i = 0; i < count; ++i) {
      const std::int64_t cell = begin + i;
      const std::array<std::int64_t, 3> at{cell % place.count[0], cell / place.count[0] % place.count[1],
                                           cell / (place.count[0] * place.count[1])};
      for (std::size_t axis = 0; axis < 3; ++axis)
        position[static_cast<std::size_t>(3 * i) + axis] =
            (static_cast<double>(place.first[axis] + at[axis]) + 0.5) * place.edge;
    }
    pipeline.density({position.data(), count, 3}, {&density_[static_cast<std::size_t>(begin)], count, 1});
    for (std::int64_t i = 0; i < count && opaque; ++i) {
      bool inside = true;
      for (int axis = 0; axis < 3; ++axis) {
        const double x = position[static_cast<std::size_t>(3 * i + axis)];
        inside = inside && x > bounds.lo[axis] && x < bounds.hi[axis];
      }
      if (!inside) density_[static_cast<std::size_t>(begin + i)] = static_cast<float>(kSolid / place.edge);
    }
  }
}

// Shares of a row's pixels: what of each one's light ends in which cube.
void SplatVolume::follow(const RayCamera& camera, const RayLimits& limits, std::int32_t width, std::int32_t row,
                         std::vector<Share>& into) const {
  const double step = kStep * place_.edge;
  for (std::int32_t column = 0; column < width; ++column) {
    double origin[3], direction[3], near_far[2];
    cast_ray(camera, limits, column, row, origin, direction, near_far);
    if (!(near_far[1] > near_far[0])) continue;
    const Vec3d from{origin[0], origin[1], origin[2]}, way{direction[0], direction[1], direction[2]};
    const auto pixel = static_cast<std::uint32_t>(row * width + column);
    float left = 1;
    // Two cubes farther than rays are rendered: the wall on the bounds lies behind them.
    for (double t = near_far[0]; t < near_far[1] + 3 * place_.edge && left > 0.01F; t += step) {
      const auto cell = place_.cell_of(from + t * way);
      if (!cell) continue;
      const float share = left * (1 - std::exp(-density_[*cell] * static_cast<float>(step)));
      left -= share;
      const auto distance = static_cast<float>(std::max(t, step));  // near pixels are smaller
      if (share > kLeastShare)
        into.push_back({static_cast<std::uint32_t>(*cell), pixel, share, share / (distance * distance)});
    }
  }
}

void SplatVolume::add(const RayCamera& camera, const RenderedFrame& frame, const RayLimits& limits) {
  labels_ = labels_ || !frame.label.empty();
  std::vector<std::vector<Share>> rows(kRowsAtOnce);
  for (std::int32_t begin = 0; begin < frame.height_px; begin += kRowsAtOnce) {
    const std::int32_t count = std::min(kRowsAtOnce, frame.height_px - begin);
    parallel_for(count, [&](std::int64_t r) {
      rows[static_cast<std::size_t>(r)].clear();
      follow(camera, limits, frame.width_px, begin + static_cast<std::int32_t>(r), rows[static_cast<std::size_t>(r)]);
    });
    for (std::int32_t r = 0; r < count; ++r)
      for (const Share& share : rows[static_cast<std::size_t>(r)]) add_share(share, frame);
  }
}

void SplatVolume::add_share(const Share& share, const RenderedFrame& frame) {
  std::int32_t& number = number_[share.cell];
  if (number < 0) {
    number = static_cast<std::int32_t>(seen_.size());
    seen_.emplace_back().cell = share.cell;
  }
  Seen& seen = seen_[static_cast<std::size_t>(number)];
  seen.light += share.light;
  seen.weight += share.weight;
  for (std::size_t k = 0; k < 3; ++k) seen.color[k] += share.weight * frame.rgb[3 * share.pixel + k];
  if (frame.label.empty() || frame.label[share.pixel] == kVoid) return;
  if (seen.lead <= 0) seen.label = frame.label[share.pixel];  // a majority of weights [Boyer91]
  seen.lead = std::abs(seen.lead + (seen.label == frame.label[share.pixel] ? share.weight : -share.weight));
}

Splats SplatVolume::splats() const {
  Splats out;
  out.deviation = kSplatWidth * place_.edge;
  for (const Seen& seen : seen_) {
    const double opacity = splat_opacity(static_cast<double>(density_[seen.cell]) * place_.edge, kSplatWidth);
    if (seen.light < kLeastLight || opacity <= 0) continue;
    const auto cell = static_cast<std::int64_t>(seen.cell);
    const std::array<std::int64_t, 3> at{cell % place_.count[0], cell / place_.count[0] % place_.count[1],
                                         cell / (place_.count[0] * place_.count[1])};
    Vec3d place;
    for (int axis = 0; axis < 3; ++axis)
      place[axis] =
          (static_cast<double>(place_.first[static_cast<std::size_t>(axis)] + at[static_cast<std::size_t>(axis)]) +
           0.5) *
          place_.edge;
    out.points.positions.push_back(place);
    out.opacity.push_back(static_cast<float>(opacity));
    auto& color = out.points.attributes.color.emplace_back();
    for (std::size_t k = 0; k < 3; ++k)
      color[k] = static_cast<std::uint8_t>(std::lround(255 * std::clamp(seen.color[k] / seen.weight, 0.0F, 1.0F)));
    if (labels_) out.points.attributes.label.push_back(seen.label);
  }
  return out;
}

}  // namespace semfield
