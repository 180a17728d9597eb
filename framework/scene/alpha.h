// The channel `alpha`: how much of each pixel the subject covers. Bytes in files and in memory, a column of floats on
// the way between them, as every further channel.
#pragma once

#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "scene/scene.h"

namespace semfield {

inline constexpr std::string_view kAlphaChannel = "alpha";

/// What a frame tells that has one.
FrameChannelInfo alpha_info(const Camera& camera);
/// The channel of bytes [H * W], 255 is 1.
FrameChannel alpha_channel(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> alpha);
/// [H * W] of a channel with values in [0, 1]; undoes alpha_channel exactly.
std::vector<std::uint8_t> alpha_bytes(const FrameChannel& channel);

}  // namespace semfield
