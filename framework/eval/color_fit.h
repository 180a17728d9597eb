// Colours of a view under an affine map of its own: cameras change exposure and white balance, which a field knows of
// the cameras it was trained on alone.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace semfield {

/// `predicted` [H, W, 3] with its left half under the 3 x 4 map of colours that fits the right half to `truth` best in
/// squared error, and the other way round, so that no pixel is scored by a map that has seen it. Values that are not
/// finite stay, and are left out of the fits, and so are those of masked pixels (`used` [H, W] is 0; empty: none).
std::vector<float> fitted_by_halves(std::span<const float> truth, std::span<const float> predicted,
                                    std::int32_t width_px, std::span<const std::uint8_t> used = {});

}  // namespace semfield
