// Where a pixel of one view lies in another, and whether that view sees the same surface there.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "session/settings/fusion_params.h"
#include "surface/seen_surface.h"

namespace semfield {

/// Whether the surface in a pixel of `view` is the one at z-depth `z_m` there (FusionParams::agree). False without
/// depth: what the pixel sees is then unknown.
bool same_surface(const PosedDepth& view, std::size_t pixel, double z_m, const FusionParams& params);

/// The pixel of `view` that sees `point`: project_point and same_surface.
std::optional<PixelHit> seen_at(const PosedDepth& view, Vec3d point, const FusionParams& params);

/// Which of `others` (ascending, without the target) are asked for `target`, ascending. `views` 0: all. `even`: ranks
/// floor((k + 1/2) n / views). `nearest`: the least |c - c'| + |g - g'|, c a camera's centre and g the point on its
/// axis at the median depth of the target (1 without depth), so that turning counts like moving; of equals the earlier
/// one.
std::vector<int> choose_views(std::span<const PosedDepth> views, int target, std::vector<int> others,
                              const FusionParams& params);

}  // namespace semfield
