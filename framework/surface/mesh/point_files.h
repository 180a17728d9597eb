// Labelled points in formats of other programs, and the JSON that says what handed files hold.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "scene/camera_rig.h"
#include "scene/classes/class_table.h"
#include "surface/mesh/mesh_files.h"

namespace semfield {

/// PCD 0.7, binary: x y z (float, less `offset`), normal_x normal_y normal_z, rgb (as PCL packs it); with semantics
/// label (uint: the id) and entropy (float, nats); with objects instance (uint, 0 = none).
void write_pcd(const std::string& path, const PointSet& points, const ClassTable& classes, Vec3d offset);

/// LAS 1.4, point format 7: whole steps of a millionth of the box's decade(), a thousandth of a millimetre in a room,
/// from the middle of the box in whole decades (both in the header); colours with 16 bits; classification: the class's
/// id, 255 for one above 254. Extra bytes, which the header describes: label (uint16: the id), entropy (float) and,
/// with objects, instance (uint32). A table of classification names, of 15 bytes each. No coordinate system of the
/// earth is named. Returns the offset of the header, which readers add by themselves.
Vec3d write_las(const std::string& path, const PointSet& points, const ClassTable& classes);

// What files for other programs cannot say themselves: where their coordinates come from and what their numbers mean.

/// A file, and what was taken from its coordinates: those of the input are the file's plus `offset`.
struct HandedFile {
  std::string path;
  std::string holds;             ///< "surface", "points", "voxels", "costmap"
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
/// poses_inverted, camera_axes_flipped}, files [{file, holds, offset, edge}], classes [{id, name, color, ignore}],
/// objects
/// [{id, name}]. Files are named without their folders.
std::string sidecar_json(const Sidecar& sidecar);

}  // namespace semfield
