#include "model/losses/distortion/distortion.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, DistortionParams& p) {
  SEMFIELD_PARAM(visit, p, space, "how distances along a ray are mapped to [0, 1]: linearly, or by 1 / t [Barron22]");
}

SEMFIELD_PLUGIN_MODULE(distortion, "1.0", [](Registry& registry) {
  registry.add_loss<DistortionLoss>(
      "distortion", "light of a ray comes from one place [Barron22, Eq. 15]; too early, it condenses fog",
      "two walks along each ray and the gradient of its weights");
})

}  // namespace semfield
