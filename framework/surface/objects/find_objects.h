// Objects of a run from segments of its training images: the surface, the network that learns from segments, the
// groups, and a row of a table for each.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "config/params.h"
#include "config/settings/run_config.h"
#include "surface/objects/object_network.h"

namespace semfield {

/// A box that may be turned: |(p - center) . axis[i]| <= size[i] / 2.
struct TurnedBox {
  Vec3d center;
  std::array<Vec3d, 3> axis;  ///< unit vectors of the world, right-handed; the last is up, where that is known
  Vec3d size;                 ///< metres, or the scene's unit
};

struct ObjectRow {
  std::int32_t id = 0;               ///< from 1 on; the number in images and files
  std::int16_t class_index = kVoid;  ///< kVoid: not known
  std::string name;                  ///< that a person gave it; "": none
  double class_probability = 0;      ///< share of all votes that are for it
  double agreement = 0;              ///< mean share of its sights in a view that lie in one segment
  std::int32_t views = 0;            ///< training views that see it
  std::int64_t points = 0;
  double area = 0;  ///< of the surface that is seen, square metres, by cells
  Vec3d centroid;
  TurnedBox box;
};

/// Cells that touch each cell, itself first: those of cell c are of[first[c]] .. of[first[c + 1] - 1].
struct TouchingCells {
  std::vector<std::int32_t> first, of;
};
TouchingCells touching_cells(const SurfaceCells& cells);

/// What was found. Views and pool lie in `surface`.
struct FoundObjects {
  ObjectSurface surface;
  TouchingCells touching;  ///< of the cells of the pool
  std::unique_ptr<ObjectNetwork<float>> network;
  std::unique_ptr<Grouping> grouping;
  std::vector<float> place;            ///< [points, width] of Grouping::place
  std::vector<std::int32_t> id;        ///< [points] object, 0: none
  std::vector<std::int16_t> class_of;  ///< [points] class of the field or of segments, kVoid: not known
  std::vector<bool> stuff;      ///< [classes] no objects: objects.stuff, and those of no segment if these say theirs
  std::vector<ObjectRow> rows;  ///< by id, from 1 on without gaps
  std::optional<Vec3d> up;      ///< up_of_cameras of the views
  std::int64_t shown = 0;       ///< segments that show on the surface
  std::vector<std::size_t> unclaimed;                   ///< clicks of things that no object came of
  std::vector<std::pair<std::string, double>> seconds;  ///< of each part of the work
};

/// Called with the part of the work and what is done of all of it; may be null.
using ObjectStages = std::function<void(const char* stage, double done, double of)>;

/// Renders the training views of `session`, and changes nothing of the run. Clicks are objects as they are
/// (clicked_objects), and `grouping` learns them for the borders between cells. Throws Error(data) for clicks on a run
/// without classes.
FoundObjects find_objects(Session& session, const SegmentSet& segments, std::unique_ptr<Grouping> grouping,
                          const KernelTables& kernels, const ObjectStages& progress);

/// Objects in the pixels of a camera, [H * W] ids, 0: none. `label` [H * W] class indices of the same pixels, or empty:
/// where it has a class, objects of that class alone are taken as far as one is near.
std::vector<std::int32_t> object_ids(Session& session, FoundObjects& objects, const RayCamera& camera,
                                     std::span<const std::int16_t> label);

// Points of a surface that are one object: clusters of segments by what the network says, joined where
// views say so.

struct ClusterRules {
  double reach = 0.25;             ///< in the space of Grouping::place
  std::int64_t neighbours = 4;     ///< segments within reach that make a segment the inside of a cluster
  double agree = 0.5;              ///< share of the sights of two groups in one segment from which they are one
  double least_views = 1;          ///< views in which two groups are seen, from which their segments decide
  std::int64_t least_points = 20;  ///< of an object
};

/// Places of the points [N, width] (Grouping::place), and their classes [N], kVoid: not known; empty: of none. Classes
/// of `stuff` [classes] have no objects.
struct PlacedPoints {
  View<const float> place;
  std::span<const std::int16_t> class_of;
  std::vector<bool> stuff;
};

/// The group of every point of the pool, from 0 on by descending size; -1: of no object.
///
/// Segments of all views are clustered by density [Ester96], each at the mean place of its points: the middle of a
/// segment lies where its object does, also where the network blurs a border. A point is of the cluster that most of
/// its segments are of, or stuff where most are segments of stuff; points of one cluster in cells that touch are a
/// group, so that what is far apart in the room is never one object by its place alone. Groups that views put into
/// several segments come apart along the surface. Then pairs of groups are joined, the surest first: a view that sees
/// both says by how much of them lies in one segment whether they are one. Of pairs that too few views see, those are
/// joined that touch and whose means are within reach. Groups that lie mostly in segments of others are none. Points
/// without a group, and those of groups too small, go to a group of their class beside them, the nearest by place. The
/// same for the same input.
std::vector<std::int32_t> cluster_points(const SurfacePool& pool, const PlacedPoints& points,
                                         std::span<const SegmentSights> sights, const ClusterRules& rules);

// Objects that a person has clicked: the clicks of a file, and the points of the surface that each one means.

/// The clicks of a log of label events, a run's own clicks.jsonl or another one. Throws as read_click_log and replay;
/// Error(data) for a class that the scene's table does not have and for a log without clicks.
SegmentSet segments_of_clicks(const std::string& file, const SceneInfo& info, Diagnostics& diagnostics);

/// What clicks mean.
struct ClickedObjects {
  std::vector<std::int32_t> id;        ///< [points] object, 0: none; from 1 on in the order of the first click
  std::vector<std::int16_t> class_of;  ///< [objects] class index of their clicks
  std::vector<std::size_t> unclaimed;  ///< clicks of things that no point of an object lies under
};

/// The objects of the points of the pool. A point is of the
/// click that the cheapest way over the surface leads to (SurfaceGraph), as far as ways lead over points of the click's
/// class: `class_of` [points]. Clicks with a number are one object, wherever they are; clicks without one are an object
/// for each piece of their class that touches; what lies under one click is one piece where it touches. Clicks of
/// `stuff` [classes] and of void are no object's. Where the field sees fewer than `least` points of the class at a
/// click, the surface around it is taken, as far as it is smooth and of one colour. A smaller piece counts where it has
/// any point of the class, so the wall that shows behind the rim of a thing does not; an object has at least `least`
/// points.
ClickedObjects clicked_objects(const ObjectSurface& surface, const TouchingCells& touching,
                               std::span<const std::int16_t> class_of, const std::vector<bool>& stuff,
                               std::span<const Annotations::Mark> clicks, std::int64_t least);

}  // namespace semfield
