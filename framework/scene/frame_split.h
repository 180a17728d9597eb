// Which frames are held out for tests where nothing but their order tells.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/error.h"
#include "scene/scene.h"

namespace semfield {

/// The parameter `test_every` of datasets that list frames. A frame's rank is its place in the order of names; frames
/// are ranked before any is left out, so that a missing file moves no other frame to another split.
struct HoldOut {
  std::int32_t every = 8;  ///< 0 = none
  std::int32_t first = 0;  ///< rank of the first frame held out

  /// A single frame trains.
  Split split_of(std::size_t rank, std::size_t frames) const;
};

/// Reports test_every: 1.
void check_test_every(std::int32_t every, Diagnostics& diagnostics);

}  // namespace semfield
