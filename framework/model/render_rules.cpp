#include "model/render_rules.h"

#include <string>

namespace semfield {

void describe(ParamVisitor& visit, SemanticsParams& p) {
  SEMFIELD_PARAM(visit, p, weight, "lambda, weight of the semantic loss relative to the colour loss [Zhi21, Eq. 7]",
                 {0, 1e6});
  SEMFIELD_PARAM(visit, p, stop_gradient_to_density, "true: the semantic loss does not shape geometry");
  SEMFIELD_PARAM(visit, p, hidden_width, "width of the semantic hidden layer [Zhi21: 128]", {1, 1024});
  SEMFIELD_PARAM(visit, p, normalisation, "what the summed cross-entropy of a batch is divided by");
  SEMFIELD_PARAM(visit, p, balance_classes, "weight classes by inverse log frequency [Paszke16]");
}

void describe(ParamVisitor& visit, RenderingParams& p) {
  SEMFIELD_PARAM(visit, p, density_activation, "raw density to attenuation per unit_m");
  SEMFIELD_PARAM(visit, p, density_bias, "added to raw density; negative: training starts from thin fog", {-20, 20});
  SEMFIELD_PARAM(visit, p, far, "what a ray meets behind its last sample");
  SEMFIELD_PARAM(visit, p, density_noise, "standard deviation of the noise on raw density in training [Mildenhall20]",
                 {0, 1e3});
  SEMFIELD_PARAM(visit, p, background, "colour behind everything, three values in [0, 1]", {0, 1});
  SEMFIELD_PARAM(visit, p, early_stop,
                 "transmittance below which rendering stops a ray; the error is at most this share; 0: never",
                 {0, 0.1});
  SEMFIELD_PARAM(visit, p, scene_scale,
                 "factor from metres to a metric encoder's coordinates [Zhi21: 0.1]; 0: from the scene's bounds",
                 {0, 1e6});
  SEMFIELD_PARAM(
      visit, p, unit_m,
      "length that density and the losses count as 1, so that results do not depend on a scene's unit; 0: half the "
      "distance at which cameras see things, at most a quarter of the bounds, and with contracted space the whole "
      "distance; run.yaml has the number",
      {0, 1e12});
  SEMFIELD_PARAM(
      visit, p, outside,
      "what lies outside the bounds: nothing, or all of space, contracted so that encoders hold it [Barron22]");
}

void validate(const RenderingParams& p, Diagnostics& diagnostics) {
  if (p.background.size() != 3) {
    diagnostics.error("config.value.length", "rendering.background",
                      "expected 3 values, got " + std::to_string(p.background.size()), "write [r, g, b]");
  }
}

}  // namespace semfield
