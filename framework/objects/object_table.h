// Classes of points and of objects by votes, and what a table says of an object.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "objects/find_objects.h"

namespace semfield {

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
