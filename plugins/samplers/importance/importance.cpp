// Parameters, traits and registration of the importance sampler.
#include "samplers/importance/importance.h"

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, ImportanceParams& params) {
  SEMFIELD_PARAM(visit, params, samples, "N_f, new samples per ray [Mildenhall20]", {1, 65536});
  SEMFIELD_PARAM(visit, params, keep_previous, "evaluate the previous pass's samples too, merged with the new ones");
  SEMFIELD_PARAM(visit, params, floor,
                 "weight spread evenly over the ray before sampling, against a total of at most 1", {1e-9, 1});
  SEMFIELD_PARAM(
      visit, params, quadrature,
      "rule of the rendering integral: paper (order 1), midpoint (cells, no jitter), stratified_bin (cells)");
}

void bad_proposal_weight(std::int64_t ray, std::int64_t sample, double weight) {
  throw Error(ErrorKind::failure, "train.weight.invalid",
              "sampler 'importance': weight of ray " + std::to_string(ray) + ", sample " + std::to_string(sample) +
                  " of the previous pass is " + std::to_string(weight) + "; it must be finite and not negative",
              "lower the learning rate, or go back to the last checkpoint");
}

SEMFIELD_PLUGIN_MODULE(importance, "1.0", [](Registry& registry) {
  importance_kernels(registry.kernels());
  registry.add_sampler<Importance, ImportanceParams>("importance", "Samples where the previous pass found weight.");
})

}  // namespace semfield
