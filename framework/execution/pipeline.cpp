#include "execution/pipeline.h"

#include <algorithm>
#include <cmath>

#include "compute/float_mode.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "execution/lane_executor.h"
#include "execution/network_plan.h"

namespace semfield {

template <class Real>
Pipeline<Real>::Pipeline(std::vector<PassParts<Real>> passes, PipelineOptions options, bool trainable)
    : options_(std::move(options)), store_(options_.seed, options_.lanes, trainable) {
  SEMFIELD_CHECK(!passes.empty(), "a pipeline needs a pass");
  SEMFIELD_CHECK(options_.lanes > 0, "lanes_of has chosen their number");
  std::vector<const PassParts<Real>*> parts_of;
  passes_.reserve(passes.size());
  store_.freeze(options_.cameras.alone);
  for (PassParts<Real>& parts : passes) {
    passes_.emplace_back(std::move(parts), options_.rules, store_);
    parts_of.push_back(&passes_.back().parts());
  }
  store_.freeze(false);
  if (trainable && options_.cameras.any()) cameras_.emplace(options_.cameras, *passes_.front().parts().stages, store_);
  tile_rays_ = tile_rays_of(parts_of, options_, per_ray_);
  lanes_ = std::make_unique<LaneExecutor<Real>>(*this);
  executor_ = lanes_.get();
  derive(0);
}

template <class Real>
Pipeline<Real>::~Pipeline() = default;

template <class Real>
void Pipeline<Real>::run_on(std::unique_ptr<Executor<Real>> executor) {
  other_ = std::move(executor);
  executor_ = other_.get();
}

template <class Real>
void Pipeline<Real>::derive(std::int64_t step) {
  const WorkScope scope(options_.work);
  const ComputeFloatMode mode;
  StepContext ctx = lanes_->context(step, false);
  for (const Pass<Real>& pass : passes_) {
    ctx.pass = pass.parts().number;
    pass.derive(ctx);
  }
  if (cameras_) cameras_->derive(ctx);
}

template <class Real>
std::size_t Pipeline<Real>::predicted_workspace_bytes(std::int64_t rays) const {
  const WorkScope scope(options_.work);
  std::vector<const PassParts<Real>*> parts;
  for (const Pass<Real>& pass : passes_) parts.push_back(&pass.parts());
  return plan_network(parts, options_, rays, thread_count(), true, 1).workspace();
}

template <class Real>
BatchScales Pipeline<Real>::scales_of(const RayBatch& batch) const {
  const std::int64_t rays = batch.origin.rows;
  BatchScales scales;
  scales.color = color_normaliser(batch);
  if (has_semantics() && !batch.targets.label.empty()) {
    const std::vector<float>& weight = options_.class_weight;
    const View<const float> weights =
        weight.empty() ? View<const float>()
                       : View<const float>(weight.data(), 1, static_cast<std::int32_t>(weight.size()));
    const SemanticTargets targets = semantic_targets(batch.targets, rays);
    scales.semantic =
        semantic_normaliser(options_.rules.semantics.normalisation, labelled_weight(targets, weights), rays);
  }
  scales.terms = options_.losses.scales(batch.terms, batch.targets, rays);
  return scales;
}

template <class Real>
StepLosses Pipeline<Real>::means_of(const StepLosses& sums, const BatchScales& scales) const {
  StepLosses mean = sums;
  mean.color /= scales.color;
  mean.mse /= scales.color;
  mean.semantic = scales.semantic > 0 ? sums.semantic / scales.semantic : 0;
  mean.active = scales.terms.active;
  mean.total =
      mean.color + options_.rules.semantics.weight * mean.semantic + options_.losses.finish(scales.terms, mean.terms);
  return mean;
}

template <class Real>
void Pipeline<Real>::render(const RenderJob<Real>& job) {
  executor_->render(job);
}

template <class Real>
void Pipeline<Real>::density(View<const double> positions, View<Real> sigma) const {
  executor_->density(positions, sigma);
}

template <class Real>
StepLosses Pipeline<Real>::gradients(std::int64_t step, const RayBatch& batch) {
  return lanes_->gradients(step, batch);
}

template <class Real>
std::optional<RayFault> Pipeline<Real>::find_fault(std::int64_t step, const RayBatch& batch) {
  return lanes_->find_fault(step, batch);
}

template class Pipeline<float>;
template class Pipeline<double>;

}  // namespace semfield
