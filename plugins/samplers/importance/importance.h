// The importance sampler: more samples where the previous pass found weight.
#pragma once

#include "config/params.h"
#include "core/error.h"
#include "plugin/kernels.h"
#include "plugin/sampler.h"
#include "samplers/importance/importance_kernels.h"

namespace semfield {

struct ImportanceParams {
  std::int64_t samples = 128;
  bool keep_previous = true;
  double floor = 1e-3;
  Quadrature quadrature = Quadrature::paper;
};

void describe(ParamVisitor& visit, ImportanceParams& params);
void validate(const ImportanceParams& params, Diagnostics& diagnostics);

/// Inverse CDF of the density p(t) that is constant on each cell of the previous samples (borders midway between
/// neighbours, ends at near and far), with mass (w_k + floor * share of the ray) / (sum w + floor). The floor keeps
/// every place within reach; with zero weights sampling is uniform. Draws are stratified, so they come out ascending
/// and are merged, not sorted.
template <class Real>
class Importance final : public Sampler<Real> {
 public:
  Importance(const ImportanceParams& params, const SamplerBuild& build, const KernelTables& kernels);
  SamplerTraits traits() const noexcept override;
  std::int64_t capacity(std::int64_t rays, std::int64_t previous_per_ray) const noexcept override;

 protected:
  void do_sample(const StepContext& ctx, const Tensors<Real>& tensors, const Rays<Real>& rays,
                 const Proposal<Real>* previous, Samples<Real>& out) const override;

 private:
  const ImportanceKernels<Real>* kernels_;
  ImportanceParams params_;
};

extern template class Importance<float>;
extern template class Importance<double>;

}  // namespace semfield
