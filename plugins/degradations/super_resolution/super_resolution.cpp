// Super-resolution: labels known on a grid of every S-th row and column only.
#include <algorithm>

#include "labels/training_labels.h"
#include "plugin/module.h"

namespace semfield {

namespace {

enum class GridMode { dense, sparse };

}  // namespace

SEMFIELD_CHOICES(GridMode, "dense", "sparse");

namespace {

class SuperResolution final : public Degradation {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, factor, "side of a cell of the coarse grid, pixels", {2, 64});
    SEMFIELD_PARAM(visit, *this, mode,
                   "dense: a cell takes the label of its middle pixel; sparse: rows and columns divisible by factor "
                   "keep theirs, all else is void");
  }

  StepFacts apply(const LoadedScene& scene, std::uint64_t, LabelSet& labels) const override {
    return change_hard_labels(scene, "super_resolution", labels, [&](std::size_t f, std::vector<std::int16_t>& hard) {
      const std::int32_t width = scene.frames[f].width_px, height = scene.frames[f].height_px;
      const std::vector<std::int16_t> clean = hard;
      for (std::int32_t y = 0; y < height; ++y) {
        for (std::int32_t x = 0; x < width; ++x) {
          std::int16_t& label = hard[index(x, y, width)];
          if (label == kVoid) continue;
          if (mode == GridMode::sparse) {
            if (x % factor != 0 || y % factor != 0) label = kVoid;
          } else {
            label = clean[index(middle(x, width), middle(y, height), width)];
          }
        }
      }
    });
  }

  int factor = 8;
  GridMode mode = GridMode::dense;

 private:
  static std::size_t index(std::int32_t x, std::int32_t y, std::int32_t width) {
    return static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
  }
  // Pixel that holds the centre of the cell of `x`; a cell at the edge may be narrower.
  std::int32_t middle(std::int32_t x, std::int32_t size) const {
    const std::int32_t first = x / factor * factor;
    return first + std::min(factor, size - first) / 2;
  }
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(super_resolution, "1.0", [](Registry& registry) {
  registry.add_degradation<SuperResolution>("super_resolution",
                                            "labels of a coarse grid: spread over its cells, or alone among void");
})

}  // namespace semfield
