#include "scene/frame_split.h"

namespace semfield {

Split HoldOut::split_of(std::size_t rank, std::size_t frames) const {
  if (every <= 0 || frames < 2) return Split::train;
  return rank % static_cast<std::size_t>(every) == static_cast<std::size_t>(first) ? Split::test : Split::train;
}

void check_test_every(std::int32_t every, Diagnostics& diagnostics) {
  if (every == 1)
    diagnostics.error("scene.split.empty", "test_every", "1 leaves no frame to train on",
                      "take 2 or more, or 0 for no test frames");
}

}  // namespace semfield
