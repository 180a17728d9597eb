// What the parts of bundle adjustment share: the surface that depth shows.
#pragma once

#include <optional>

#include "scene/bundle.h"

namespace semfield::bundle_parts {

inline constexpr double kOffDepth = 0.15;  ///< relative distance beyond which a point is not of the surface shown
inline constexpr std::size_t kFewestOnDepth = 50;

/// The surface that a frame's depth shows where a point in the axes of its depth camera is seen.
struct Facet {
  Vec3d at, normal;
};
/// Nothing at edges, without depth, and far from the surface.
std::optional<Facet> facet_at(const BundleDepth& view, Vec3d p);

}  // namespace semfield::bundle_parts
