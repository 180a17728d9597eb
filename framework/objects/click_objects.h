// Objects that a person has clicked: the clicks of a file, and the points of the surface that each one means.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "objects/find_objects.h"

namespace semfield {

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
