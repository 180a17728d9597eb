// Points of a bundle against the depth that frames show.
#include <algorithm>
#include <cmath>
#include <optional>

#include "scene/survey/bundle_parts.h"

namespace semfield {

using namespace bundle_parts;

namespace {

constexpr double kDepthEdge = 0.04;  // relative step of depth between neighbours that is an edge

}  // namespace

std::optional<Facet> bundle_parts::facet_at(const BundleDepth& view, Vec3d p) {
  const Camera& c = view.camera;
  if (view.depth_m.empty() || !c.sees(p) || !c.is_within_lens(p)) return {};
  double u = 0, v = 0;
  c.project(p, u, v);
  if (!(u >= 1 && v >= 1 && u < c.width_px - 1 && v < c.height_px - 1)) return {};
  const auto x = static_cast<std::int32_t>(u), y = static_cast<std::int32_t>(v);
  const auto at = [&](std::int32_t dx, std::int32_t dy) -> std::optional<Vec3d> {
    const double depth =
        static_cast<double>(view.depth_m[static_cast<std::size_t>(y + dy) * static_cast<std::size_t>(c.width_px) +
                                         static_cast<std::size_t>(x + dx)]);
    const Vec3d ray = c.direction(x + dx + 0.5, y + dy + 0.5);
    if (!(depth > 0) || !(c.depth_of(ray) > 0)) return {};
    return ray * (depth / c.depth_of(ray));
  };
  const auto middle = at(0, 0), left = at(-1, 0), right = at(1, 0), up = at(0, -1), down = at(0, 1);
  if (!middle || !left || !right || !up || !down) return {};
  const double reach = length(*middle);
  for (const auto& side : {left, right, up, down}) {
    if (std::abs(length(*side) - reach) > kDepthEdge * reach) return {};
  }
  const Vec3d normal = cross(*right - *left, *down - *up);
  if (!(length(normal) > 0)) return {};
  Facet out{*middle, normalized(normal)};
  const double off = std::abs(dot(out.normal, p - out.at));
  return off < kOffDepth * reach ? std::optional<Facet>(out) : std::nullopt;
}

double share_on_depth(const Bundle& bundle) {
  std::size_t all = 0, on = 0;
  for (const Track& track : bundle.tracks) {
    for (const Sighting& s : track.seen) {
      const auto f = static_cast<std::size_t>(s.frame);
      if (f >= bundle.depth.size()) continue;
      const Vec3d p = bundle.depth_from_color.apply(bundle.poses[f].apply_inverse(track.point));
      const std::optional<Facet> facet = facet_at(bundle.depth[f], p);
      if (!facet) continue;
      ++all;
      on += std::abs(dot(facet->normal, p - facet->at)) < 0.02 * length(p) ? 1 : 0;
    }
  }
  return all < kFewestOnDepth ? -1 : static_cast<double>(on) / static_cast<double>(all);
}

}  // namespace semfield
