// The degradations that `scene.labels.degrade` may name.
#include "labels/degradations/degradations.h"

namespace semfield {

const std::vector<StepKind<Degradation>>& degradation_kinds() {
  static const std::vector<StepKind<Degradation>> kinds{
      {"pixel_noise", "uniform random classes, void included, on an exact share of each frame's pixels",
       make_pixel_noise},
      {"region_noise", "a wrong class on whole instances in a share of the frames that see them", make_region_noise},
      {"super_resolution", "labels of a coarse grid: spread over its cells, or alone among void",
       make_super_resolution},
      {"propagation", "one click or one grown region per class and frame; the rest is void", make_propagation},
      {"simulated_predictions", "soft or hard labels with the errors of a network, simulated from the clean labels",
       make_simulated_predictions},
  };
  return kinds;
}

}  // namespace semfield
