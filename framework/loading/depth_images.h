// Depth kept as an image or as a NumPy array.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "formats/image_io.h"
#include "scene/camera.h"

namespace semfield {

/// Whether values are taken as they are: files of real numbers (.exr, .pfm, .npy, .tif) are in the unit of the poses.
bool has_real_depth(const std::string& path);

/// The size of an image, or of the array of a .npy file, [height, width] with axes of length 1 besides. Throws as
/// image_size and npy_shape do.
ImageSize depth_size(const std::string& path);

/// z-depth in metres at the file's own size; 0 where it is not finite, negative, or at the 16-bit ceiling 65535.
/// `unit_m` are the metres of one step where the values are integers. Throws as the readers of images and arrays do.
Image<float> read_depth(const std::string& path, double unit_m = 0.001);

/// The values of an image at another size, each that of the nearest pixel [height * width].
std::vector<float> at_nearest_pixels(const Image<float>& image, std::int32_t width, std::int32_t height);

// Depth that another camera than the one of the colours took, drawn into the colour image.

struct DepthCamera {
  Camera camera;          ///< at the size of the depth images
  Pose depth_from_color;  ///< OpenCV axes of both, unit of the poses
};

/// [H * W] depth (Camera::depth_of) of the colour camera; 0 where none is seen. The surface between neighbouring depth
/// pixels is drawn, the nearest of several; across an edge, where depth jumps by over 4 %, there is none.
std::vector<float> drawn_depth(const Image<float>& depth, const DepthCamera& from, const Camera& color);

}  // namespace semfield
