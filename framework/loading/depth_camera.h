// Depth that another camera than the one of the colours took, drawn into the colour image.
#pragma once

#include <cstdint>
#include <vector>

#include "formats/image_io.h"
#include "scene/camera.h"

namespace semfield {

struct DepthCamera {
  Camera camera;          ///< at the size of the depth images
  Pose depth_from_color;  ///< OpenCV axes of both, unit of the poses
};

/// [H * W] depth (Camera::depth_of) of the colour camera; 0 where none is seen. The surface between neighbouring depth
/// pixels is drawn, the nearest of several; across an edge, where depth jumps by over 4 %, there is none.
std::vector<float> drawn_depth(const Image<float>& depth, const DepthCamera& from, const Camera& color);

}  // namespace semfield
