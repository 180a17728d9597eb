// The stratified sampler: one sample in each of N equal bins of a ray.
#pragma once

#include "config/params.h"
#include "core/error.h"
#include "plugin/kernels.h"
#include "plugin/sampler.h"
#include "samplers/stratified/stratified_kernels.h"

namespace semfield {

struct StratifiedParams {
  std::int64_t samples = 64;
  Quadrature quadrature = Quadrature::paper;
  SampleSpacing spacing = SampleSpacing::linear;
};

void describe(ParamVisitor& visit, StratifiedParams& params);
void validate(const StratifiedParams& params, Diagnostics& diagnostics);

/// Bins from near to far, equal in distance along the ray or in disparity.
template <class Real>
class Stratified final : public Sampler<Real> {
 public:
  Stratified(const StratifiedParams& params, const SamplerBuild& build, const KernelTables& kernels);
  SamplerTraits traits() const noexcept override { return {}; }
  std::int64_t capacity(std::int64_t rays, std::int64_t previous_per_ray) const noexcept override;

 protected:
  void do_sample(const StepContext& ctx, const Tensors<Real>& tensors, const Rays<Real>& rays,
                 const Proposal<Real>* previous, Samples<Real>& out) const override;

 private:
  const StratifiedKernels<Real>* kernels_;
  StratifiedParams params_;
};

extern template class Stratified<float>;
extern template class Stratified<double>;

}  // namespace semfield
