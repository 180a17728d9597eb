// The stratified sampler: one sample in each of N equal bins of a ray.
#pragma once

#include "config/params.h"
#include "plugin/kernels.h"
#include "plugin/sampler.h"
#include "samplers/stratified/stratified_kernels.h"

namespace semfield {

void describe(ParamVisitor& visit, StratifiedParams& params);

/// Bins from near to far, equal in distance along the ray or in disparity.
template <class Real>
class Stratified final : public Sampler<Real> {
 public:
  Stratified(const StratifiedParams& params, const SamplerBuild& build, const KernelTables& kernels)
      : kernels_(&kernels.get<StratifiedKernels<Real>>(build.device, "sampler 'stratified'")), params_(params) {}
  SamplerTraits traits() const noexcept override { return {}; }
  std::int64_t capacity(std::int64_t rays, std::int64_t) const noexcept override { return rays * params_.samples; }

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

}  // namespace semfield
