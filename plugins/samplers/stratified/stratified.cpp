// Parameters, traits and registration of the stratified sampler.
#include "samplers/stratified/stratified.h"

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, StratifiedParams& params) {
  SEMFIELD_PARAM(visit, params, samples, "N_c, samples per ray [Mildenhall20]", {1, 65536});
  SEMFIELD_PARAM(
      visit, params, quadrature,
      "rule of the rendering integral: paper (order 1), midpoint (order 2, no jitter), stratified_bin (1.5)");
  SEMFIELD_PARAM(
      visit, params, spacing,
      "linear: bins of equal length in metres; disparity: bins of equal length in 1 / t, where a near below a "
      "thousandth of far counts as that");
}

SEMFIELD_PLUGIN_MODULE(stratified, "1.0", [](Registry& registry) {
  stratified_kernels(registry.kernels());
  registry.add_sampler<Stratified, StratifiedParams>(
      "stratified", "One sample in each of N bins of the ray, equal in distance or disparity.");
})

}  // namespace semfield
