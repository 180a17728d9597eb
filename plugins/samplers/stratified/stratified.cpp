// The stratified sampler: one sample in each of N equal bins of a ray.
#include "config/params.h"
#include "plugin/kernels.h"
#include "plugin/module.h"
#include "plugin/registry.h"
#include "plugin/sampler.h"
#include "samplers/stratified/stratified_kernels.h"

namespace semfield {

/// Bins from near to far, equal in distance along the ray or in disparity.
template <class Real>
class Stratified final : public Sampler<Real> {
 public:
  Stratified(const StratifiedParams& params, const SamplerBuild& build, const KernelTables& kernels)
      : kernels_(&kernels.get<StratifiedKernels<Real>>(build.device, "sampler 'stratified'")), params_(params) {}
  SamplerTraits traits() const noexcept override { return {}; }
  std::int64_t capacity(std::int64_t rays, std::int64_t, bool) const noexcept override {
    return rays * params_.samples;
  }

 protected:
  void do_sample(const StepContext& ctx, const Tensors<Real>&, const Rays<Real>& rays, const Proposal<Real>*,
                 Samples<Real>& out) const override {
    const bool jitter = ctx.training && params_.quadrature != Quadrature::midpoint;
    kernels_->sample({params_, jitter, ctx.random("sampler/stratified"), ctx.first_ray}, rays.near_far, out);
  }

 private:
  const StratifiedKernels<Real>* kernels_;
  StratifiedParams params_;
};

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
