// Objects of a run from segments of its training images: the surface, the network that learns from segments, the
// groups, and a row of a table for each.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "objects/object_network.h"
#include "objects/object_surface.h"
#include "session/settings/objects_params.h"

namespace semfield {

/// A box that may be turned: |(p - center) . axis[i]| <= size[i] / 2.
struct TurnedBox {
  Vec3d center;
  std::array<Vec3d, 3> axis;  ///< unit vectors of the world, right-handed
  Vec3d size;                 ///< metres, or the scene's unit
};

struct ObjectRow {
  std::int32_t id = 0;               ///< from 1 on; the number in images and files
  std::int16_t class_index = kVoid;  ///< kVoid: not known
  std::string name;                  ///< that a person gave it; "": none
  double class_probability = 0;      ///< share of the votes for the class that has most
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
  std::vector<bool> stuff;             ///< [classes] whether the class has no objects
  std::vector<ObjectRow> rows;         ///< by id, from 1 on without gaps
  std::vector<std::size_t> unclaimed;  ///< clicks of things that no object came of
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

}  // namespace semfield
