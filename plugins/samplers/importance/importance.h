// The importance sampler: more samples where the previous pass found weight.
#pragma once

#include "config/params.h"
#include "plugin/kernels.h"
#include "plugin/sampler.h"
#include "samplers/importance/importance_kernels.h"

namespace semfield {

void describe(ParamVisitor& visit, ImportanceParams& params);

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
  std::int64_t capacity(std::int64_t rays, std::int64_t previous_per_ray) const noexcept override {
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

}  // namespace semfield
