#include "scene/alpha.h"

#include <cmath>

namespace semfield {

FrameChannelInfo alpha_info(const Camera& camera) {
  return {std::string(kAlphaChannel), camera.height_px, camera.width_px, 1};
}

FrameChannel alpha_channel(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> alpha) {
  FrameChannel out{std::string(kAlphaChannel), height_px, width_px, 1, {}};
  out.values.reserve(alpha.size());
  for (const std::uint8_t a : alpha) out.values.push_back(static_cast<float>(a) / 255.0F);
  return out;
}

std::vector<std::uint8_t> alpha_bytes(const FrameChannel& channel) {
  std::vector<std::uint8_t> out;
  out.reserve(channel.values.size());
  for (const float a : channel.values) out.push_back(static_cast<std::uint8_t>(std::lround(a * 255.0F)));
  return out;
}

}  // namespace semfield
