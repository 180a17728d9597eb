// Propagation: a frame keeps one click, or one grown region, of each class that it shows.
#include <algorithm>

#include "core/rng.h"
#include "labels/training_labels.h"
#include "plugin/module.h"

namespace semfield {

namespace {

constexpr std::string_view kPropagation = "propagation";

// Grows regions of one label over a frame, breadth first over the four neighbours, so that a region stays compact and
// any part of it that was reached first is connected.
class Grower {
 public:
  Grower(const std::vector<std::int16_t>& label, std::int32_t width)
      : label_(label), width_(static_cast<std::size_t>(width)), taken_(label.size(), 0) {}

  bool taken(std::size_t pixel) const { return taken_[pixel] != 0; }

  /// Takes up to `count` pixels connected with `seed`, itself first; returns how many.
  std::int64_t grow(std::size_t seed, std::int64_t count) {
    queue_.assign(1, seed);
    taken_[seed] = 1;
    for (std::size_t head = 0; head < queue_.size(); ++head) {
      const std::size_t pixel = queue_[head], x = pixel % width_;
      if (pixel >= width_) reach(pixel - width_, seed, count);
      if (x > 0) reach(pixel - 1, seed, count);
      if (x + 1 < width_) reach(pixel + 1, seed, count);
      if (pixel + width_ < label_.size()) reach(pixel + width_, seed, count);
    }
    return static_cast<std::int64_t>(queue_.size());
  }

 private:
  void reach(std::size_t pixel, std::size_t seed, std::int64_t count) {
    if (taken_[pixel] != 0 || label_[pixel] != label_[seed] || static_cast<std::int64_t>(queue_.size()) == count)
      return;
    taken_[pixel] = 1;
    queue_.push_back(pixel);
  }

  const std::vector<std::int16_t>& label_;
  std::size_t width_;
  std::vector<char> taken_;
  std::vector<std::size_t> queue_;
};

// What a frame's classes kept.
struct Kept {
  std::int64_t classes = 0, regions = 0;
};

class Propagation final : public Degradation {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, share,
                   "share of a class's pixels in the frame that a region grown from a random pixel keeps; 0 = that one "
                   "pixel",
                   {0, 1});
  }

  StepFacts apply(const LoadedScene& scene, std::uint64_t seed, LabelSet& labels) const override {
    const auto classes = static_cast<std::size_t>(scene.info.classes.valid_count());
    std::vector<Kept> kept(labels.size());
    StepFacts facts =
        change_hard_labels(scene, kPropagation, labels, [&](std::size_t f, std::vector<std::int16_t>& hard) {
          kept[f] = keep_regions({seed, f, stream_id("labels/propagation")}, classes, scene.frames[f].width_px, hard);
        });
    Kept sum;
    for (const Kept& k : kept) {
      sum.classes += k.classes;
      sum.regions += k.regions;
    }
    facts.emplace_back("clicks (a class of a frame)", std::to_string(sum.classes));
    facts.emplace_back("regions, where one was too small for the share", std::to_string(sum.regions));
    return facts;
  }

  double share = 0;

 private:
  Kept keep_regions(const RandomAddress& address, std::size_t classes, std::int32_t width,
                    std::vector<std::int16_t>& hard) const {
    std::vector<std::vector<std::size_t>> pixels_of(classes);
    for (std::size_t p = 0; p < hard.size(); ++p) {
      if (hard[p] != kVoid) pixels_of[static_cast<std::size_t>(hard[p])].push_back(p);
    }
    Kept kept;
    Grower grower(hard, width);
    for (std::size_t c = 0; c < classes; ++c) {
      const std::vector<std::size_t>& pixels = pixels_of[c];
      if (pixels.empty()) continue;
      ++kept.classes;
      std::int64_t wanted = std::max<std::int64_t>(1, rounded_share(share, static_cast<std::int64_t>(pixels.size())));
      // When a component is used up, the next one is that of the next pixel in reading order, around the frame's end.
      const std::size_t click = uniform_below(address, c, pixels.size());
      for (std::size_t k = 0; k < pixels.size() && wanted > 0; ++k) {
        const std::size_t seed = pixels[(click + k) % pixels.size()];
        if (grower.taken(seed)) continue;
        wanted -= grower.grow(seed, wanted);
        ++kept.regions;
      }
    }
    std::vector<std::int16_t> result(hard.size(), kVoid);
    for (std::size_t p = 0; p < hard.size(); ++p) {
      if (grower.taken(p)) result[p] = hard[p];
    }
    hard = std::move(result);
    return kept;
  }
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(propagation, "1.0", [](Registry& registry) {
  registry.add_degradation<Propagation>("propagation",
                                        "one click or one grown region per class and frame; the rest is void");
})

}  // namespace semfield
