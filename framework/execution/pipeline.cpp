#include "execution/pipeline.h"

#include <algorithm>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "execution/lane_executor.h"

namespace semfield {

namespace {

constexpr std::int64_t kTileRows = 512;  // samples that a tile aims at: as fast as more, and many threads share evenly
constexpr std::int64_t kExpectedOccupied = 32;  // samples per ray that a single-pass sampler is expected to keep

// Lanes are what threads share, so this many keep 2, 3, 4, 6, 8, 12, 16, 24 or 48 of them busy alike.
constexpr std::int64_t kMostLanes = 48;
constexpr std::int64_t kEvenLanes = 16;  // a number of lanes that memory bounds is a multiple of it
constexpr std::int64_t kLaneNumbers = std::int64_t{64} << 20;  // of all lanes of a run
// Samples of a lane at least: to add a parameter's lane and to clear it takes as long as some ten samples do.
constexpr std::int64_t kLaneRows = 512;

/// Numbers of a gradient lane.
template <class Real>
std::int64_t lane_numbers(const PassParts<Real>& parts) {
  std::int64_t sum = lane_size<Real>(*parts.position) + lane_size<Real>(*parts.sampler) + lane_size<Real>(*parts.field);
  if (parts.direction) sum += lane_size<Real>(*parts.direction);
  if (parts.head) sum += lane_size<Real>(*parts.head);
  const auto add_branch = [&](const BranchParts<Real>& branch) {
    sum += lane_size<Real>(*branch.position) + lane_size<Real>(*branch.field);
  };
  if (parts.branch) add_branch(*parts.branch);
  for (const HeadParts<Real>& one : parts.heads) {
    sum += lane_size<Real>(*one.head);
    add_branch(*one.branch);
  }
  return sum;
}

/// Most samples per ray after each pass.
template <class Real>
std::vector<std::int64_t> samples_per_ray(const std::vector<PassParts<Real>>& passes) {
  std::vector<std::int64_t> per_ray;
  for (const PassParts<Real>& parts : passes)
    per_ray.push_back(parts.sampler->capacity(1, per_ray.empty() ? 0 : per_ray.back()));
  return per_ray;
}

}  // namespace

template <class Real>
PipelineOptions settled(PipelineOptions options, const std::vector<PassParts<Real>>& passes) {
  SEMFIELD_CHECK(!passes.empty(), "a pipeline needs a pass");
  const std::vector<std::int64_t> per_ray = samples_per_ray(passes);
  const std::int64_t most = passes.back().sampler->traits().single_pass
                                ? std::min(per_ray.back(), kExpectedOccupied)
                                : *std::max_element(per_ray.begin(), per_ray.end());
  const std::int64_t expected = std::max<std::int64_t>(most, 1);  // samples of a ray
  if (options.tile_rays == 0) options.tile_rays = std::clamp<std::int64_t>(kTileRows / expected, 4, 64);
  if (options.lanes > 0) return options;
  SEMFIELD_CHECK(options.rays > 0, "lanes that are left open need the rays of a step");
  const std::int64_t tiles = (options.rays + options.tile_rays - 1) / options.tile_rays;
  std::int64_t numbers = 0;
  for (const PassParts<Real>& parts : passes) numbers += lane_numbers(parts);
  const std::int64_t in_memory = kLaneNumbers / std::max<std::int64_t>(numbers, 1);
  std::int64_t lanes = std::min({kMostLanes, in_memory, options.rays * expected / kLaneRows});
  if (lanes < tiles && lanes > kEvenLanes) lanes -= lanes % kEvenLanes;
  options.lanes = static_cast<int>(std::clamp<std::int64_t>(lanes, 1, tiles));
  return options;
}

template <class Real>
Pipeline<Real>::Pipeline(std::vector<PassParts<Real>> passes, PipelineOptions options, bool trainable)
    : per_ray_(samples_per_ray(passes)),
      options_(settled(std::move(options), passes)),
      store_(options_.seed, options_.lanes, trainable) {
  passes_.reserve(passes.size());
  store_.freeze(options_.cameras.alone);
  for (PassParts<Real>& parts : passes) passes_.emplace_back(std::move(parts), options_.rules, store_);
  store_.freeze(false);
  if (trainable && options_.cameras.any()) cameras_.emplace(options_.cameras, *passes_.front().parts().stages, store_);
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

template class Pipeline<float>;
template class Pipeline<double>;
template PipelineOptions settled<float>(PipelineOptions, const std::vector<PassParts<float>>&);
template PipelineOptions settled<double>(PipelineOptions, const std::vector<PassParts<double>>&);

}  // namespace semfield
