// Points that the depth of training frames shows: taken frame by frame while the frames are read, so that bounds and
// distances are known even where depth itself is not kept.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "scene/scene.h"

namespace semfield {

/// World points of a sparse grid of pixels and their distances along the rays, metres; only where depth is valid.
struct SurveyPoints {
  std::vector<float> x, y, z, distance;
  std::int64_t looked_at = 0;  ///< pixels of the grid
};

/// Where the points of frames are, as far as bounds may believe them.
struct SurveyedExtent {
  Box bounds;
  double near_m = 0, far_m = 0;
  std::int64_t points = 0;
};

/// Of points whose depth is estimated: the outermost half per cent each way is dropped, and the box then grown by
/// `margin` of its size each way. Nothing without points.
std::optional<SurveyedExtent> extent_of_points(std::vector<SurveyPoints> parts, double margin = 0.05);

/// Pixels between two that are looked at, each way: 4, or the power of two beyond that keeps `pixels` in all (of the
/// frames surveyed) below 2^20 points.
std::int32_t survey_step(std::int64_t pixels);

/// Points of one frame. Pose and camera belong to the buffer's size.
SurveyPoints survey_frame(const Camera& camera, const Pose& world_from_camera, const FrameBuffer& frame,
                          std::int32_t step);

}  // namespace semfield
