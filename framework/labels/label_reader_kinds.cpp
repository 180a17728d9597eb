// The label files that `scene.labels.from` may name.
#include "labels/label_steps.h"

namespace semfield {

const std::vector<StepKind<LabelReader>>& label_reader_kinds() {
  static const std::vector<StepKind<LabelReader>> kinds{};
  return kinds;
}

}  // namespace semfield
