// Pixel noise: an exact number of distinct pixels per frame gets uniform random classes.
#include <cmath>
#include <numeric>

#include "core/rng.h"
#include "labels/training_labels.h"
#include "plugin/module.h"

namespace semfield {

namespace {

constexpr std::string_view kPixelNoise = "pixel_noise";

// Pixels of a frame in a random order of which only the first `count` places are made: Fisher-Yates, so they are
// distinct and a larger ratio of the same seed takes the same pixels and more.
std::vector<std::uint32_t> drawn_pixels(const RandomAddress& address, std::size_t pixels, std::size_t count) {
  std::vector<std::uint32_t> order(pixels);
  std::iota(order.begin(), order.end(), 0U);
  for (std::size_t k = 0; k < count; ++k) std::swap(order[k], order[k + uniform_below(address, k, pixels - k)]);
  order.resize(count);
  return order;
}

class PixelNoise final : public Degradation {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, ratio, "share of each frame's pixels that get a random class, rounded down", {0, 1});
    SEMFIELD_PARAM(visit, *this, flip_void, "true: void pixels that are drawn get a class too");
  }

  StepFacts apply(const LoadedScene& scene, std::uint64_t seed, LabelSet& labels) const override {
    const std::vector<std::int16_t> classes = scene_classes(scene, kPixelNoise);
    std::vector<std::int64_t> drawn(labels.size()), left_void(labels.size());
    StepFacts facts =
        change_hard_labels(scene, kPixelNoise, labels, [&](std::size_t f, std::vector<std::int16_t>& hard) {
          const RandomAddress place{seed, f, stream_id("labels/pixel_noise/place")};
          const RandomAddress value{seed, f, stream_id("labels/pixel_noise/class")};
          // 0.29 * 100 is 29, though the product of doubles is just below it.
          const auto count = static_cast<std::size_t>(std::floor(ratio * static_cast<double>(hard.size()) + 1e-6));
          for (const std::uint32_t pixel : drawn_pixels(place, hard.size(), count)) {
            ++drawn[f];
            if (hard[pixel] == kVoid && !flip_void) {
              ++left_void[f];
              continue;
            }
            const std::uint64_t c = uniform_below(value, pixel, classes.size() + 1);
            hard[pixel] = c == classes.size() ? kVoid : classes[c];
          }
        });
    const auto total = [](const std::vector<std::int64_t>& n) {
      return std::to_string(std::accumulate(n.begin(), n.end(), std::int64_t{0}));
    };
    facts.emplace_back("pixels drawn", total(drawn));
    facts.emplace_back("void pixels drawn and left void", total(left_void));
    facts.emplace_back("classes drawn from, besides void", std::to_string(classes.size()));
    return facts;
  }

  double ratio = 0.5;
  bool flip_void = false;
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(pixel_noise, "1.0", [](Registry& registry) {
  registry.add_degradation<PixelNoise>(
      "pixel_noise", "uniform random classes, void included, on an exact share of each frame's pixels");
})

}  // namespace semfield
