// Loss `glow` of CPUs alone: bright rays cost.
#include "plugin/loss.h"
#include "plugin/module.h"

namespace semfield {

struct GlowParams : LossRule {
  GlowParams() { weight = 0.01; }
  double gain = 1;
};
void describe(ParamVisitor& visit, GlowParams& p);
void describe(ParamVisitor& visit, GlowParams& p) {
  SEMFIELD_PARAM(visit, p, gain, "factor of a ray's red, green and blue", {0, 10});
}

class GlowLoss final : public LossOf<GlowLoss, GlowParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    LossTraits traits;
    traits.moves = {channel::color};
    return traits;
  }
  template <class Real>
  double sum(const RayTargets&, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    double sum = 0;
    for (std::int64_t r = 0; r < values.color.rows; ++r) {
      for (std::int32_t c = 0; c < 3; ++c) {
        sum += params.gain * static_cast<double>(values.color(r, c));
        gradients.color(r, c) += static_cast<Real>(scale * params.gain);
      }
    }
    return sum;
  }
};

namespace {
void register_into(Registry& registry) { registry.add_loss<GlowLoss>("glow", "bright rays cost", "a sum per ray"); }
}  // namespace

SEMFIELD_PLUGIN_MODULE(glow, "1.0", register_into)

}  // namespace semfield
