#include "losses/generalised_cross_entropy/generalised_cross_entropy.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, GeneralisedCrossEntropyParams& p) {
  SEMFIELD_PARAM(
      visit, p, q,
      "between cross-entropy (towards 0), which trusts every label, and 1, the absolute error, which lets go "
      "of labels that the network contradicts [Zhang18]",
      {0.01, 1});
}

SEMFIELD_PLUGIN_MODULE(generalised_cross_entropy, "1.0", [](Registry& registry) {
  registry.add_loss<GeneralisedCrossEntropy>(
      "generalised_cross_entropy",
      "Class labels many of which may be wrong: (1 - p^q) / q of the label's class [Zhang18].",
      "an exponential per class and labelled ray");
})

}  // namespace semfield
