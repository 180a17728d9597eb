// Points of a surface that are one object: clusters of segments by what the network says, joined where
// views say so.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "config/params.h"
#include "objects/object_surface.h"

namespace semfield {

struct ClusterRules {
  double reach = 0.25;             ///< in the space of Grouping::place
  std::int64_t neighbours = 4;     ///< segments within reach that make a segment the inside of a cluster
  double agree = 0.5;              ///< share of the sights of two groups in one segment from which they are one
  double least_views = 1;          ///< views in which two groups are seen, from which their segments decide
  std::int64_t least_points = 20;  ///< of an object
};

/// Places of the points [N, width] (Grouping::place), of which `stuff` [N] are no object's; empty: none are.
struct PlacedPoints {
  View<const float> place;
  std::span<const bool> stuff;
};

/// The group of every point of the pool, from 0 on by descending size; -1: of no object.
///
/// Segments of all views are clustered by density [Ester96], each at the mean place of its points: the middle of a
/// segment lies where its object does, also where the network blurs a border. A point is of the cluster that most of
/// its segments are of, and points of one cluster in cells that touch are a group, so that what is far apart in the
/// room is never one object by its place alone. Then pairs of groups are joined, the surest first: a view that sees
/// both says by how much of them lies in one segment whether they are one. Of pairs that too few views see, those are
/// joined that touch and whose means are within reach. Points without a group, and those of groups too small, go to a
/// group beside them, the nearest by place. The same for the same input.
std::vector<std::int32_t> cluster_points(const SurfacePool& pool, const PlacedPoints& points,
                                         std::span<const SegmentSights> sights, const ClusterRules& rules);

}  // namespace semfield
