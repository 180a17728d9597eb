#include "losses/cosine_distance/cosine_distance.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, CosineDistanceParams& p) {
  SEMFIELD_PARAM(visit, p, channel, "the channel of the dataset and of the head that makes it");
}

SEMFIELD_PLUGIN_MODULE(cosine_distance, "1.0", [](Registry& registry) {
  registry.add_loss<CosineDistance>("cosine_distance",
                                    "The angle between a head's channel and the dataset's channel of its name.",
                                    "a product per ray and column");
})

}  // namespace semfield
