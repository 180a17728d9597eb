// A labelled point cloud from rendered depth of many views, thinned by voxels.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <unordered_map>

#include "eval/evaluator.h"
#include "surface/mesh/mesh_files.h"

namespace semfield {

/// One point a cube of edge `voxel` (world units): mean place and mean colour of what was seen in it; label and entropy
/// of the surest sight. Points come in the order in which cubes were first met, so views in the same order give the
/// same cloud.
class PointCloud {
 public:
  /// `background` is the colour behind the scene that rendering adds where light is left. Throws Error(usage) for an
  /// edge that is no positive number.
  explicit PointCloud(double voxel, const std::array<double, 3>& background = {});

  /// Adds the pixels of a rendered view whose opacity is at least `least_opacity`. Rendered depth and colour
  /// are divided by opacity here: the mean of what was met.
  void add(const RayCamera& camera, const RenderedFrame& frame, float least_opacity = 0.9F);
  PointSet points() const;

 private:
  struct Cell {
    Vec3d place_sum;
    std::array<double, 3> color_sum{};
    std::int64_t count = 0;
    std::int16_t label = -1;
    float entropy = 0;
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
