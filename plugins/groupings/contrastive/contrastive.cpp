// Contrastive: points of one segment are pulled together, segments of an image are pushed apart.
#include "groupings/contrastive/contrastive.h"

#include "plugin/module.h"

namespace semfield {

SEMFIELD_PLUGIN_MODULE(contrastive, "1.0", [](Registry& registry) {
  registry.add_grouping<Contrastive>(
      "contrastive", "An embedding per point: segments are pulled together, and pushed from others of their image.",
      true);
})

}  // namespace semfield
