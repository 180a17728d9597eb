// Objects as files keep them: points of the surface, which object each is of, and a row per object.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <vector>

#include "objects/find_objects.h"

namespace semfield {

/// Files hold as many, like classes of a PLY file.
inline constexpr std::int32_t kMostObjects = 1024;

/// What was found, without what found it. Points are those of SurfacePool, one per cell.
struct ObjectSet {
  SurfaceCells cells;
  std::vector<Vec3d> position;                     ///< [points] world
  std::vector<std::array<std::uint8_t, 3>> color;  ///< [points] of the photographs
  std::vector<std::int32_t> id;                    ///< [points] object, 0: none
  std::vector<std::int16_t> class_of;              ///< [points] class index, kVoid: not known
  std::vector<ObjectRow> rows;                     ///< by id from 1 on; one that was merged away has no points
  std::string about;                               ///< JSON object: how they were found

  /// The object of the surface at a place of the world, 0: none. A place off all points takes the one of those within
  /// kReach cells.
  std::int32_t at(Vec3d place) const;
  static constexpr double kReach = 4;
  /// Tells one result of `semfield objects` from another: 16 hexadecimal digits of the ids that were found.
  std::string digest() const;
};

ObjectSet object_set(const FoundObjects& found, std::string about);

/// found.safetensors of a folder that `semfield objects` wrote: what was found, before edits. Throws as
/// write_safetensors.
void write_object_set(const std::string& path, const ObjectSet& set);
/// `classes`: valid ones of the run's table. Throws Error(no_input) as TensorFile::read; Error(data) naming the file
/// and the number for anything that is none, or that a run with these classes cannot have.
ObjectSet read_object_set(const std::string& path, int classes);

// Classes of points and of objects by votes, and what a table says of an object.

/// Class probabilities of points [N, classes]; a row of zeros: not known.
struct PointClasses {
  int classes = 0;
  std::vector<float> probability;

  std::vector<std::int16_t> most_probable() const;  ///< [N], kVoid: not known
};

/// By the field's logits where the run has semantics, else by the classes of the segments that the points lie in.
PointClasses classes_of_points(Session& session, std::span<const Vec3d> positions,
                               std::span<const SegmentSights> sights);

/// Points, area, centroid and box of every row, from points at `position` [N] with ids of rows, or 0. A row without
/// points gets a box without size.
void measure_objects(std::span<ObjectRow> rows, std::span<const Vec3d> position, std::span<const std::int32_t> id,
                     double cell_m);

/// A row per object of `id` [N], by id.
std::vector<ObjectRow> object_table(const ObjectSurface& surface, std::span<const std::int32_t> id,
                                    std::span<const SegmentSights> sights, const PointClasses& classes);

}  // namespace semfield
