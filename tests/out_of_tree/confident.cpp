// A loss of other people on logits: classes of labelled rays are far from undecided.

#include "plugin/module.h"

namespace outside {

using namespace semfield;

struct ConfidentParams : LossRule {
  ConfidentParams() { weight = 0.001; }
  double margin = 1;
};

void describe(ParamVisitor& visit, ConfidentParams& p) {
  SEMFIELD_PARAM(visit, p, margin, "how far the label's logit should lie above 0", {0, 100});
}

/// max(0, margin - s_y)^2 of the label's logit.
class Confident final : public LossOf<Confident, ConfidentParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    LossTraits traits;
    traits.targets = {channel::label};
    traits.heads = {channel::logits};
    traits.moves = {channel::logits};
    return traits;
  }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t) const override {
    std::int64_t labelled = 0;
    for (std::int64_t r = 0; r < batch.label.rows; ++r) labelled += batch.label(r, 0) >= 0 ? 1 : 0;
    return labelled;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    const View<const Real> logits = values.heads[channel::logits];
    const View<Real> d_logits = gradients.heads[channel::logits];
    double sum = 0;
    for (std::int64_t r = 0; r < logits.rows && !targets.label.empty(); ++r) {
      const std::int16_t label = targets.label(r, 0);
      if (label < 0) continue;
      const double short_by = params.margin - static_cast<double>(logits(r, label));
      if (short_by <= 0) continue;
      sum += short_by * short_by;
      d_logits(r, label) += static_cast<Real>(-2 * scale * short_by);
    }
    return sum;
  }
};

void register_into(Registry& registry);
void register_into(Registry& registry) {
  registry.add_loss<Confident>("confident", "Logits of labels below a margin cost.", "a product per labelled ray");
}

}  // namespace outside

SEMFIELD_PLUGIN_MODULE(confident, "1.0", outside::register_into)
