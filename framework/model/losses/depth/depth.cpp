#include "model/losses/depth/depth.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, DepthLossParams& p) {
  SEMFIELD_PARAM(visit, p, kind,
                 "expected: the error of the rendered depth, in units of rendering.unit_m; line_of_sight: the share of "
                 "a ray's light from "
                 "outside a band about the true depth [Rematas22]");
  SEMFIELD_PARAM(visit, p, truncate_m,
                 "for kind expected: errors beyond this many metres have no gradient; 0: every error has one",
                 {0, 1e12});
  SEMFIELD_PARAM(
      visit, p, band_m,
      "for kind line_of_sight: half the width of the band, metres, wider than the spacing of samples; 0: a tenth of "
      "rendering.unit_m",
      {0, 1e12});
}

SEMFIELD_PLUGIN_MODULE(depth, "1.0", [](Registry& registry) {
  registry.add_loss<DepthLoss>("depth", "depth images of training frames; pixels without depth count for nothing",
                               "depth of training frames in memory, two bytes per pixel, and its gradient");
})

}  // namespace semfield
