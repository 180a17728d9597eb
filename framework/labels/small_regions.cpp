#include "labels/small_regions.h"

#include <array>

#include "core/check.h"

namespace semfield {

namespace {

// Pixels that share an edge with pixel `i`; -1 beyond the border.
std::array<std::int64_t, 4> neighbours(std::int64_t i, std::int32_t width, std::int32_t height) {
  const std::int64_t column = i % width, row = i / width;
  return {row > 0 ? i - width : -1, column > 0 ? i - 1 : -1, column + 1 < width ? i + 1 : -1,
          row + 1 < height ? i + width : -1};
}

}  // namespace

SmallRegions fill_small_regions(std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height,
                                std::int64_t min_area_px) {
  SEMFIELD_CHECK(std::ssize(label) == std::int64_t{width} * height, "a label map has a label for each pixel");
  SmallRegions found;
  std::vector<bool> seen(label.size()), small(label.size());
  std::vector<std::int64_t> queue;
  for (std::int64_t first = 0; first < std::ssize(label); ++first) {
    if (seen[static_cast<std::size_t>(first)]) continue;
    queue.assign(1, first);
    seen[static_cast<std::size_t>(first)] = true;
    for (std::size_t next = 0; next < queue.size(); ++next) {
      for (const std::int64_t n : neighbours(queue[next], width, height)) {
        if (n < 0 || seen[static_cast<std::size_t>(n)] ||
            label[static_cast<std::size_t>(n)] != label[static_cast<std::size_t>(first)])
          continue;
        seen[static_cast<std::size_t>(n)] = true;
        queue.push_back(n);
      }
    }
    if (std::ssize(queue) >= min_area_px) continue;
    for (const std::int64_t i : queue) small[static_cast<std::size_t>(i)] = true;
    ++found.regions;
    found.pixels += std::ssize(queue);
  }
  if (found.pixels == std::ssize(label)) return {};
  // Larger regions grow into the small ones from all sides, a pixel at a time: what they fill is connected to them.
  queue.clear();
  for (std::int64_t i = 0; i < std::ssize(label); ++i) {
    if (!small[static_cast<std::size_t>(i)]) queue.push_back(i);
  }
  for (std::size_t next = 0; next < queue.size(); ++next) {
    for (const std::int64_t n : neighbours(queue[next], width, height)) {
      if (n < 0 || !small[static_cast<std::size_t>(n)]) continue;
      small[static_cast<std::size_t>(n)] = false;
      label[static_cast<std::size_t>(n)] = label[static_cast<std::size_t>(queue[next])];
      queue.push_back(n);
    }
  }
  return found;
}

}  // namespace semfield
