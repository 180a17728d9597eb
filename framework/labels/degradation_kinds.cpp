// The degradations that `scene.labels.degrade` may name.
#include "labels/label_steps.h"

namespace semfield {

const std::vector<StepKind<Degradation>>& degradation_kinds() {
  static const std::vector<StepKind<Degradation>> kinds{};
  return kinds;
}

}  // namespace semfield
