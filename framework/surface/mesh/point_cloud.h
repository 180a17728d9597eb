// A labelled point cloud from rendered depth of many views, thinned by voxels.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <unordered_map>

#include "eval/evaluator.h"
#include "surface/mesh/mesh_files.h"

namespace semfield {

/// Where the pixels of a rendered view see a surface [H * W]: its place in the world, the unit normal of what the
/// pixels around show, towards the eye, and the side of the square that the pixel covers there. Depth is divided by
/// opacity: the mean of what was met.
struct SeenPixels {
  std::vector<char> seen;  ///< 0: opacity under `least_opacity`, or no depth
  std::vector<Vec3d> place, normal;
  std::vector<float> footprint;
};
SeenPixels seen_pixels(const RayCamera& camera, const RenderedFrame& frame, float least_opacity = 0.9F);

/// One point a cube of edge `voxel` (world units): mean place, normal and colour of what was seen in it, the least
/// footprint; label and entropy of the surest sight. Points come in the order in which cubes were first met, so views
/// in the same order give the same cloud.
class PointCloud {
 public:
  /// `background` is the colour behind the scene that rendering adds where light is left. Throws Error(usage) for an
  /// edge that is no positive number.
  explicit PointCloud(double voxel, const std::array<double, 3>& background = {});

  /// Adds what a rendered view saw. Colour is divided by opacity, as depth is.
  void add(const RenderedFrame& frame, const SeenPixels& pixels);
  PointSet points() const;

 private:
  struct Cell {
    Vec3d place_sum, normal_sum;
    std::array<double, 3> color_sum{};
    std::int64_t count = 0;
    std::int16_t label = -1;
    float entropy = 0, footprint = 0;
  };
  struct Hash {
    std::size_t operator()(const std::array<std::int64_t, 3>& key) const;
  };
  double voxel_;
  std::array<double, 3> background_;
  bool labels_ = false;
  std::unordered_map<std::array<std::int64_t, 3>, std::uint32_t, Hash> index_;
  std::vector<Cell> cells_;
};

}  // namespace semfield
