// Frames of an object before one colour: a transparent or plain background, and the box of what stands before it.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "scene/camera_rig.h"
#include "scene/scene.h"

namespace semfield {

struct PlainBackground {
  std::array<std::uint8_t, 3> color{};
  Box object;  ///< of the visual hull: of the voxels that hardly any frame shows as background
};

/// What the frames' borders show alike, when that is a quarter of all pixels too; nothing unless the cameras look
/// inward. `cameras[i]` took `pixels[i]`. Transparent pixels have the colour that the dataset put behind them.
std::optional<PlainBackground> find_plain_background(const Cameras& cameras,
                                                     const std::vector<const StoredFrame*>& pixels,
                                                     const CameraRig& rig);

}  // namespace semfield
