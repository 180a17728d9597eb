// Segments made worse in the ways of segmenters, with addressed randomness: what an evaluation of objects is tried on.
#pragma once

#include <cstdint>

#include "objects/segments.h"
#include "session/settings/objects_params.h"

namespace semfield {

/// Borders first, then merging, splitting, leaving out, and new numbers. A share is that of the image's segments,
/// rounded to the nearest number of them. A frame's result depends on `seed` and its number alone.
void damage_segments(SegmentSet& segments, const SegmentDamage& damage, std::uint64_t seed);

}  // namespace semfield
