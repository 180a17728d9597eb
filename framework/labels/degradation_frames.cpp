// Frames and classes that degradations work on.
#include "labels/degradation_frames.h"

#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "core/check.h"
#include "scene/scene_checks.h"

namespace semfield {

std::vector<std::size_t> hard_frames(const LoadedScene& scene, const LabelSet& labels, std::string_view type) {
  SEMFIELD_CHECK(labels.size() == scene.frames.size(), "one entry of labels per frame");
  std::vector<std::size_t> out;
  for (std::size_t f = 0; f < labels.size(); ++f) {
    if (labels[f].empty()) continue;
    if (!labels[f].soft.empty()) {
      throw Error(ErrorKind::data, "labels.degradation.soft",
                  std::string(type) + ": " + frame_place(scene.info.frames[f]) +
                      " has class probabilities, and this degradation works on hard labels",
                  "name it before the step that makes the labels soft, or read hard labels");
    }
    const StoredFrame& frame = scene.frames[f];
    SEMFIELD_CHECK(
        labels[f].hard.size() == static_cast<std::size_t>(frame.width_px) * static_cast<std::size_t>(frame.height_px),
        "labels have the size of their frame");
    out.push_back(f);
  }
  return out;
}

std::vector<std::int16_t> scene_classes(const LoadedScene& scene, std::string_view type) {
  const auto classes = static_cast<std::size_t>(scene.info.classes.valid_count());
  if (classes == 0) {
    throw Error(ErrorKind::data, "labels.classes.too_few",
                std::string(type) + ": the class table of the scene has no class to draw from",
                "give the scene a classes.yaml with a class that is not ignored");
  }
  std::vector<char> seen(classes, 0);
  for (const std::vector<std::int64_t>& counts : scene.class_pixels) {
    for (std::size_t c = 0; c < std::min(classes, counts.size()); ++c) {
      if (counts[c] > 0) seen[c] = 1;
    }
  }
  const bool any = std::find(seen.begin(), seen.end(), 1) != seen.end();
  std::vector<std::int16_t> out;
  for (std::size_t c = 0; c < classes; ++c) {
    if (!any || seen[c] != 0) out.push_back(static_cast<std::int16_t>(c));
  }
  return out;
}

StepFacts change_hard_labels(const LoadedScene& scene, std::string_view type, LabelSet& labels,
                             const std::function<void(std::size_t frame, std::vector<std::int16_t>& hard)>& change) {
  struct Counts {
    std::int64_t before = 0, after = 0, changed = 0;
  };
  const std::vector<std::size_t> frames = hard_frames(scene, labels, type);
  std::vector<Counts> counts(frames.size());
  parallel_for(static_cast<std::int64_t>(frames.size()), [&](std::int64_t i) {
    const std::size_t f = frames[static_cast<std::size_t>(i)];
    std::vector<std::int16_t>& hard = labels[f].hard;
    const std::vector<std::int16_t> old = hard;
    change(f, hard);
    Counts& n = counts[static_cast<std::size_t>(i)];
    for (std::size_t p = 0; p < hard.size(); ++p) {
      n.before += old[p] != kVoid ? 1 : 0;
      n.after += hard[p] != kVoid ? 1 : 0;
      n.changed += old[p] != hard[p] ? 1 : 0;
    }
  });
  Counts sum;
  for (const Counts& n : counts) {
    sum.before += n.before;
    sum.after += n.after;
    sum.changed += n.changed;
  }
  return {{"frames", std::to_string(frames.size())},
          {"labelled pixels before", std::to_string(sum.before)},
          {"labelled pixels after", std::to_string(sum.after)},
          {"pixels changed", std::to_string(sum.changed)}};
}

std::int64_t rounded_share(double share, std::int64_t count) {
  // The small number lets a decimal share count as it is written: 0.35 * 10 is a half, though the double is below it.
  return static_cast<std::int64_t>(std::floor(share * static_cast<double>(count) + 0.5 + 1e-9));
}

}  // namespace semfield
