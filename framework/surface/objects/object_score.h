// Panoptic quality of a scene: objects and stuff of all scored images together, as one.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "config/settings/run_config.h"
#include "labels/segments.h"
#include "surface/objects/find_objects.h"

namespace semfield {

/// Pixels of one image, row by row.
struct ScoredPixels {
  std::span<const std::int16_t> label;     ///< true class, kVoid: not scored
  std::span<const std::int32_t> instance;  ///< true object, 0: none
  std::span<const std::int16_t> rendered;  ///< class that the field renders
  std::span<const std::int32_t> object;    ///< found object, 0: none
};

struct ObjectFigures {
  double pq = 0, sq = 0, rq = 0;  ///< means over the classes that are true or found
  double pq_things = 0, pq_stuff = 0;
  double mcov = 0;         ///< mean over true objects of the best IoU with a found one
  double count_error = 0;  ///< sum over classes of |found - true| objects, of the true ones
  std::int64_t objects = 0, found = 0, matched = 0;
};

/// Panoptic quality over a scene [Siddiqui23 Sec. 4; Kirillov19 Eq. 1]. A segment is what one object, or one class of
/// stuff, covers in all scored images together. A true and a found segment of one class match when their IoU is above
/// one half; pixels that are void in truth count nowhere. PQ of a class is the sum of the IoU of its matches over
/// TP + FP/2 + FN/2. True objects with fewer than `least_px` pixels in all images are void, and found ones that are not
/// matched are no error where they have fewer, or where more than half of what they cover is void.
class ObjectScore {
 public:
  ObjectScore(std::span<const ObjectRow> rows, std::vector<bool> stuff, std::int64_t least_px);
  void add(const ScoredPixels& pixels);
  ObjectFigures figures() const;

  static constexpr std::int64_t kLeastPx = 300;

 private:
  using Segment = std::pair<bool, std::int32_t>;  // of stuff?, number
  std::optional<Segment> true_segment(std::int16_t label, std::int32_t instance) const;
  std::optional<Segment> found_segment(std::int16_t rendered, std::int32_t object) const;
  std::int16_t class_of(const Segment& found) const;

  std::vector<ObjectRow> rows_;
  std::vector<bool> stuff_;
  std::int64_t least_px_;
  std::map<Segment, std::map<std::int16_t, std::int64_t>> truth_;  // pixels by class
  std::map<std::pair<Segment, Segment>, std::int64_t> both_;       // true, found
  std::map<Segment, std::int64_t> found_, found_in_void_;
};

// Segments made worse in the ways of segmenters, with addressed randomness: what an evaluation of objects is tried on.

/// Borders first, then merging, splitting, leaving out, and new numbers. A share is that of the image's segments,
/// rounded to the nearest number of them. A frame's result depends on `seed` and its number alone.
void damage_segments(SegmentSet& segments, const SegmentDamage& damage, std::uint64_t seed);

}  // namespace semfield
