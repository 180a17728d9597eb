// Points that the depth of training frames shows: taken frame by frame while the frames are read, so that bounds and
// distances are known even where depth itself is not kept.
#pragma once

#include <cstdint>
#include <vector>

#include "scene/scene.h"

namespace semfield {

/// World points of a sparse grid of pixels and their distances along the rays, metres; only where depth is valid.
struct SurveyPoints {
  std::vector<float> x, y, z, distance;
  std::int64_t looked_at = 0;  ///< pixels of the grid
};

/// Pixels between two that are looked at, each way: 4, or the power of two beyond that keeps `pixels` in all (of the
/// frames surveyed) below 2^20 points.
std::int32_t survey_step(std::int64_t pixels);

/// Points of one frame. Pose and camera belong to the buffer's size.
SurveyPoints survey_frame(const Camera& camera, const Pose& world_from_camera, const FrameBuffer& frame,
                          std::int32_t step);

}  // namespace semfield
