// Whether the bounds, near and far of a scene are where its cameras look.
#pragma once

#include "loading/frame_source.h"

namespace semfield {

/// What the pixels themselves tell.
struct SeenExtent {
  const Box& box;                       ///< that the data suggest
  const std::vector<float>& distances;  ///< of depth along its rays; empty without depth
  bool taken;                           ///< the bounds of the scene are that box: nobody gave others
};

/// Rays of the training frames `usable` (a sparse grid of at most 64 of them) against bounds, near and far, and depth
/// against near and far: an error where nothing lies in what would be sampled, a warning where less than 5 % does.
void check_rays(const LoadedScene& scene, const std::vector<int>& usable, const SeenExtent& seen,
                Diagnostics& diagnostics);

}  // namespace semfield
