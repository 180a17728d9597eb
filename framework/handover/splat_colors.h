// Colours of splats, so that they look drawn as the field looks rendered.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "eval/rays.h"
#include "handover/splats.h"

namespace semfield {

/// What the field shows from a place.
struct SplatView {
  RayCamera camera;
  std::vector<std::uint8_t> rgb;  ///< [height_px, width_px, 3]
};

/// Draws the splats as viewers do, by weighted averages from front to back [Zwicker01] [Kerbl23], over `background`.
/// The picture, [height_px, width_px, 3] in 0 to 1; empty for a wide lens, whose footprints are no ellipses.
std::vector<float> draw_splats(const Splats& splats, const RayCamera& camera, const std::array<double, 3>& background);

/// Changes colours so that pictures of the splats come near the views: a viewer widens every footprint by a part of a
/// pixel and blurs what the field shows sharp. Simultaneous iterations [Gilbert72]: a splat's colour moves by the mean
/// of what its pixels miss, weighted by its share in them. Views of a wide lens say nothing. The same bits for any
/// number of threads.
void fit_colors(Splats& splats, std::span<const SplatView> views, const std::array<double, 3>& background);

}  // namespace semfield
