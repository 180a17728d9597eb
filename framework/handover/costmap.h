// A map for robots that drive: what lies in a band of heights above the floor, seen from above.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "handover/voxel_map.h"

namespace semfield {

/// Heights above the floor, world units.
struct HeightBand {
  double low = 0, high = 0;
};

/// Columns of cubes seen from the side that is up. Row 0 is the farthest along `along[1]`, as in an image.
struct Costmap {
  double edge = 0;
  std::int64_t width = 0, height = 0;
  std::array<int, 2> along{};      ///< axes of the world that run right and up in the image
  std::array<double, 2> origin{};  ///< their coordinates of the lower left corner of the image
  double floor = 0;                ///< height of the floor along `up`
  HeightBand band;
  std::vector<VoxelState> cells;  ///< [height * width]
};

/// A column is occupied where a cube in the band is, free where none is and one is free, else unknown. The floor is the
/// lowest layer of cubes with at least half as many occupied ones as the fullest layer of the lower half. `up` is an
/// axis of the world, or its opposite: with z up the image has x to the right and y up; with y up, z and x; with x up,
/// y and z, and for a negative axis the two exchanged, so that the image is no mirror. Throws Error(usage) for another
/// direction, and Error(data) where nothing is occupied.
Costmap costmap_of(const VoxelMap& map, Vec3d up, const HeightBand& band);

/// PGM (P5) and, with .yaml in place of its ending, what ROS's map_server reads with it: image, resolution, origin,
/// negate, occupied_thresh, free_thresh. 0 is occupied, 254 free, 205 unknown. Returns the YAML's path.
std::string write_costmap(const std::string& path, const Costmap& map);

}  // namespace semfield
