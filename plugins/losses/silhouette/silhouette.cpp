#include "losses/silhouette/silhouette.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor&, SilhouetteParams&) {}

SEMFIELD_PLUGIN_MODULE(silhouette, "1.0", [](Registry& registry) {
  registry.add_loss<SilhouetteLoss>(
      "silhouette", "A ray is as opaque as its pixel, of images with alpha: no fog before a background.",
      "alpha of training frames in memory, a byte per pixel, and its gradient");
})

}  // namespace semfield
