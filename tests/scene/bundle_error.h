// How far the cameras of a bundle miss what they saw.
#pragma once

#include "core/small_math.h"
#include "scene/survey/bundle.h"

namespace semfield {

/// The median of error_px() over all sightings; 0 without any.
inline double median_error_px(const Bundle& bundle) {
  std::vector<double> errors;
  for (const Track& track : bundle.tracks)
    for (const Sighting& s : track.seen) errors.push_back(error_px(bundle, track, s));
  return median_of(std::move(errors));
}

}  // namespace semfield
