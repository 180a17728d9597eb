// A COLMAP sparse model as plain structs, from text or binary files; the only place that knows them.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "core/error.h"
#include "scene/scene.h"

namespace semfield {

struct ColmapImage {
  std::string place;  ///< "images.bin: image 12 ('0017.jpg')"
  std::string name;   ///< path below the image folder, as written
  std::int64_t id = 0;
  std::int64_t camera = 0;
  Pose world_from_camera;
  std::vector<std::int64_t> points;  ///< ids of the points seen in it
};

struct ColmapModel {
  std::unordered_map<std::int64_t, Camera> cameras;  ///< by id; pixel centres are at +0.5 as written
  std::vector<ColmapImage> images;                   ///< by name
  std::unordered_map<std::int64_t, Vec3d> points;    ///< by id; empty without a points3D file
  double error_px = 0;                               ///< mean over the points of the reprojection error that it states
};

/// Reads cameras, images and points3D of `folder`, .bin where there are any, else .txt. Problems of single cameras and
/// images (a lens that is not supported, an id given twice) go into `diagnostics`; throws Error for a file that is
/// missing or damaged, naming file and offset or line.
ColmapModel read_colmap_model(const std::string& folder, Diagnostics& diagnostics);

/// cameras.bin of these cameras as COLMAP's OPENCV, or OPENCV_FISHEYE where the lens is one. k3 and k4 of others must
/// be 0.
std::string colmap_cameras_file(const std::unordered_map<std::int64_t, Camera>& cameras);

}  // namespace semfield
