// The importance sampler: more samples where the previous pass found weight.
#include "config/params.h"
#include "core/error.h"
#include "plugin/kernels.h"
#include "plugin/module.h"
#include "plugin/registry.h"
#include "plugin/sampler.h"
#include "samplers/importance/importance_kernels.h"

namespace semfield {

/// Inverse CDF of the density p(t) that is constant on each cell of the previous samples (borders midway between
/// neighbours, ends at near and far), with mass (w_k + floor * share of the ray) / (sum w + floor). The floor keeps
/// every place within reach; with zero weights sampling is uniform. Draws are stratified, so they come out ascending
/// and are merged, not sorted.
template <class Real>
class Importance final : public Sampler<Real> {
 public:
  Importance(const ImportanceParams& params, const SamplerBuild& build, const KernelTables& kernels)
      : kernels_(&kernels.get<ImportanceKernels<Real>>(build.device, "sampler 'importance'")), params_(params) {}
  SamplerTraits traits() const noexcept override { return {.needs_previous = true}; }
  std::int64_t capacity(std::int64_t rays, std::int64_t previous_per_ray, bool) const noexcept override {
    return rays * (params_.samples + (params_.keep_previous ? previous_per_ray : 0));
  }

 protected:
  void do_sample(const StepContext& ctx, const Tensors<Real>&, const Rays<Real>& rays, const Proposal<Real>* previous,
                 Samples<Real>& out) const override {
    const bool jitter = ctx.training && params_.quadrature != Quadrature::midpoint;
    kernels_->sample({params_, jitter, ctx.random("sampler/importance"), ctx.first_ray, ctx.workspace}, rays.near_far,
                     *previous, out);
  }

 private:
  const ImportanceKernels<Real>* kernels_;
  ImportanceParams params_;
};

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
