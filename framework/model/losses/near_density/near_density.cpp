#include "model/losses/near_density/near_density.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, NearDensityParams& p) {
  SEMFIELD_PARAM(visit, p, distance_m,
                 "how far from the camera the term reaches, metres along the ray; 0: 0.3 of rendering.unit_m",
                 {0, 1e12});
}

SEMFIELD_PLUGIN_MODULE(near_density, "1.0", [](Registry& registry) {
  registry.add_loss<NearDensityLoss>(
      "near_density", "space in front of a camera is empty [Yang23]; too early, it can remove all density",
      "a gradient per sample");
})

}  // namespace semfield
