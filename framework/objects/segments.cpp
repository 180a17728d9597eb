#include "objects/segments.h"

#include <algorithm>
#include <set>

#include "compute/parallel.h"

namespace semfield {

std::int32_t FrameSegments::at(std::int32_t column, std::int32_t row, std::int32_t frame_width,
                               std::int32_t frame_height) const {
  // The pixel that holds the centre of the frame's.
  const auto place = [](std::int64_t i, std::int64_t from, std::int64_t to) { return (2 * i + 1) * to / (2 * from); };
  const std::int64_t x = place(column, frame_width, width_px), y = place(row, frame_height, height_px);
  return id[static_cast<std::size_t>(y * width_px + x)];
}

std::int64_t SegmentSet::count() const {
  std::vector<std::int64_t> found(frames.size());
  parallel_for(std::ssize(frames), [&](std::int64_t f) {
    std::set<std::int32_t> ids(frames[static_cast<std::size_t>(f)].id.begin(),
                               frames[static_cast<std::size_t>(f)].id.end());
    ids.erase(0);
    found[static_cast<std::size_t>(f)] = std::ssize(ids);
  });
  std::int64_t total = std::ssize(clicks);
  for (const std::int64_t n : found) total += n;
  return total;
}

SegmentSet segments_of_scene(const LoadedScene& scene, Split split) {
  SegmentSet set;
  set.from = "instances of the scene";
  set.frames.resize(scene.frames.size());
  for (const int f : scene.frames_of(split)) {
    const StoredFrame& frame = scene.frames[static_cast<std::size_t>(f)];
    if (frame.instance.empty()) continue;
    FrameSegments& to = set.frames[static_cast<std::size_t>(f)];
    to.width_px = frame.width_px;
    to.height_px = frame.height_px;
    to.id = frame.instance;
    if (frame.label.empty()) continue;
    std::map<std::int32_t, std::map<std::int16_t, std::int64_t>> votes;
    for (std::size_t i = 0; i < to.id.size(); ++i)
      if (to.id[i] != 0 && frame.label[i] != kVoid) ++votes[to.id[i]][frame.label[i]];
    for (const auto& [id, of_class] : votes)
      to.class_of[id] = std::max_element(of_class.begin(), of_class.end(), [](const auto& a, const auto& b) {
                          return a.second < b.second;
                        })->first;
    set.classes = set.classes || !to.class_of.empty();
  }
  if (std::all_of(set.frames.begin(), set.frames.end(), [](const FrameSegments& f) { return f.empty(); }))
    throw Error(ErrorKind::data, "objects.segments.none", "no training frame of the scene has instances",
                "name segments of its images with --segments PATH");
  return set;
}

}  // namespace semfield
