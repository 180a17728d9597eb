// What files for other programs cannot say themselves: where their coordinates come from and what their numbers mean.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "scene/classes/class_table.h"
#include "scene/pose_convention.h"

namespace semfield {

/// A file, and what was taken from its coordinates: those of the input are the file's plus `offset`.
struct HandedFile {
  std::string path;
  std::string holds;             ///< "surface", "points", "splats", "voxels", "costmap"
  Vec3d offset;                  ///< world units
  std::optional<double> edge{};  ///< of a voxel or a pixel of a map, world units
};

struct Sidecar {
  std::string run, scene;
  std::int64_t step = 0;
  bool metric = true;                   ///< the unit is the metre; else it is the scene's own
  std::optional<Vec3d> up;              ///< unit vector of the world, where it is known
  PoseConvention convention;            ///< what the configuration did to the poses of the input when they were read
  const ClassTable* classes = nullptr;  ///< null: no semantics
  std::map<std::int32_t, std::string> objects;  ///< names by id; empty: none
  std::vector<HandedFile> files;
};

/// JSON of `semfield-handover-1`, with its last line's end: run, scene, step, world {unit, axes, up, pose_scale,
/// poses_inverted, axes_flipped}, files [{file, holds, offset, edge}], classes [{id, name, color, ignore}], objects
/// [{id, name}]. Files are named without their folders.
std::string sidecar_json(const Sidecar& sidecar);

}  // namespace semfield
