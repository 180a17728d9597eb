// A grid of cubes about which rendered views say whether they are free or hold a surface, and of which class.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "scene/classes/class_table.h"
#include "surface/mesh/mesh_files.h"

namespace semfield {

/// Cubes lie at whole multiples of their edge in the world, as OctoMap's do: cube (i, j, k) of the grid covers
/// (first + {i, j, k}) * edge to that plus edge. x runs fastest.
struct VoxelGridPlace {
  double edge = 0;
  std::array<std::int64_t, 3> first{}, count{};

  std::size_t cells() const { return static_cast<std::size_t>(count[0] * count[1] * count[2]); }
  std::size_t index(std::int64_t x, std::int64_t y, std::int64_t z) const {
    return static_cast<std::size_t>((z * count[1] + y) * count[0] + x);
  }
  Vec3d corner() const {
    return {static_cast<double>(first[0]) * edge, static_cast<double>(first[1]) * edge,
            static_cast<double>(first[2]) * edge};
  }
  /// The cube that holds a point, or nothing outside of the grid.
  std::optional<std::size_t> cell_of(Vec3d point) const;
  /// Covers a box. Throws Error(usage) for an edge that makes more than 4,095 cubes along an axis or 2^28 in all.
  static VoxelGridPlace covering(const Box& box, double edge);
};

enum class VoxelState : std::uint8_t { unknown, free, occupied };

/// Views are added one by one; the same views in the same order give the same map.
class VoxelMap {
 public:
  explicit VoxelMap(VoxelGridPlace place);

  /// What one view says: cubes that its rays cross before the surface are free, those that a ray ends in are occupied,
  /// whatever other rays of the view say. Log-odds are added as [Hornung13] does: +0.85 and -0.4, kept in [-2, 3.5].
  void add(const RayCamera& camera, const RenderedFrame& frame, const SeenPixels& pixels);

  const VoxelGridPlace& place() const { return place_; }
  VoxelState state(std::size_t cell) const {
    if (odds_[cell] == 0 && !known_[cell]) return VoxelState::unknown;
    return odds_[cell] > 0 ? VoxelState::occupied : VoxelState::free;
  }
  float log_odds(std::size_t cell) const { return odds_[cell]; }
  /// Class index of the rays that end in an occupied cube: that of more than half of them where there is one, else one
  /// of those that lead [Boyer91]; kVoid elsewhere.
  std::int16_t label(std::size_t cell) const { return state(cell) == VoxelState::occupied ? label_[cell] : kVoid; }
  bool has_labels() const { return has_labels_; }
  std::optional<std::size_t> cell_of(Vec3d point) const { return place_.cell_of(point); }

 private:
  void cross(Vec3d from, Vec3d to);
  void vote(std::size_t cell, std::int16_t label);

  VoxelGridPlace place_;
  bool has_labels_ = false;
  std::vector<float> odds_;
  std::vector<char> known_;
  std::vector<std::int32_t> hit_by_, crossed_by_;  // the last view that did
  std::vector<std::int16_t> label_;                // leads its cube by `lead_` votes
  std::vector<std::int32_t> lead_;
  std::int32_t views_ = 0;
};

/// A NumPy archive: occupancy int8 [x, y, z] (100 occupied, 0 free, -1 unknown), log_odds float32, with semantics
/// class_id int32 (-1 = none), and origin float64 [3] (world corner of cube 0, 0, 0) and edge float64 [].
void write_voxels(const std::string& path, const VoxelMap& map, const ClassTable& classes);

/// An octree of OctoMap of 16 levels: .bt, free and occupied, or .ot with colours, log-odds and the colours of classes.
/// Returns what was taken from the coordinates, which is not 0 where cubes lie more than 32,000 edges from 0.
Vec3d write_octomap(const std::string& path, const VoxelMap& map, const ClassTable& classes, bool with_color);

// A map for robots that drive: what lies in a band of heights above the floor, seen from above.

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
