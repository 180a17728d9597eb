#include "execution/pipeline.h"

#include <algorithm>
#include <cmath>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "execution/lane_executor.h"

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

namespace {

constexpr std::int64_t kTileRows = 512;  // samples that a tile aims at: as fast as more, and many threads share evenly
constexpr std::int64_t kExpectedOccupied = 32;  // samples per ray that a single-pass sampler is expected to keep
constexpr std::size_t kDensityRows = 1024;      // positions that Pass::density evaluates at once

// Lanes are what threads share, so this many keep 2, 3, 4, 6, 8, 12, 16, 24 or 48 of them busy alike.
constexpr std::int64_t kMostLanes = 48;
constexpr std::int64_t kEvenLanes = 16;                     // a number of lanes that memory bounds is a multiple of it
constexpr std::size_t kLaneBytes = std::size_t{256} << 20;  // of all lanes of a run in float
// Samples of a lane at least: to add a parameter's lane and to clear it takes as long as some ten samples do.
constexpr std::int64_t kLaneRows = 512;

// Samples of a tile that a semantic branch keeps; training begins with fog, whose samples all weigh.
constexpr double kKeptShare = 0.5;

std::size_t size(std::int64_t n) { return static_cast<std::size_t>(n); }

/// Samples a ray that tiles are made for.
template <class Real>
std::int64_t expected_samples(const std::vector<const PassParts<Real>*>& passes,
                              const std::vector<std::int64_t>& per_ray) {
  const std::int64_t most = passes.back()->sampler->traits().single_pass
                                ? std::min(per_ray.back(), kExpectedOccupied)
                                : *std::max_element(per_ray.begin(), per_ray.end());
  return std::max<std::int64_t>(most, 1);
}

template <class Real>
TensorBytes declared_by(const PassParts<Real>& parts, int lanes, bool trainable) {
  TensorBytes sum = declared_bytes<Real>(*parts.position, lanes, trainable);
  sum += declared_bytes<Real>(*parts.sampler, lanes, trainable);
  sum += declared_bytes<Real>(*parts.field, lanes, trainable);
  if (parts.direction) sum += declared_bytes<Real>(*parts.direction, lanes, trainable);
  if (parts.head) sum += declared_bytes<Real>(*parts.head, lanes, trainable);
  const auto add_branch = [&](const BranchParts<Real>& branch) {
    sum += declared_bytes<Real>(*branch.position, lanes, trainable);
    sum += declared_bytes<Real>(*branch.field, lanes, trainable);
  };
  if (parts.branch) add_branch(*parts.branch);
  for (const HeadParts<Real>& one : parts.heads) {
    sum += declared_bytes<Real>(*one.head, lanes, trainable);
    if (one.source_width > 0)
      sum += declared_bytes<Real>(ChannelAxes<Real>(one.source_width, one.head->width()), lanes, trainable);
    add_branch(*one.branch);
  }
  return sum;
}

/// A branch and its head on the samples that are kept of a tile.
struct BranchBytes {
  std::size_t traces = 0, backward = 0;
};
template <class Real>
BranchBytes branch_bytes(const BranchParts<Real>& branch, const Head<Real>& head, std::int64_t kept,
                         std::int64_t tile_rays, std::size_t field_feature) {
  const std::size_t out = size(branch.field->traits().feature_dims) + size(head.hidden_width());
  const std::size_t in =
      size(branch.position->traits().out_dims) + (branch.rules.reads_feature ? field_feature : std::size_t{0});
  return {size(kept) * (2 * in + out) * sizeof(Real) + branch.field->saved_bytes(kept, tile_rays),
          size(kept) * out * sizeof(Real) + branch.field->scratch_bytes(kept, tile_rays)};
}

}  // namespace

template <class Real>
std::int64_t tile_rays_of(const std::vector<const PassParts<Real>*>& passes, const PipelineOptions& options,
                          std::vector<std::int64_t>& per_ray) {
  per_ray.clear();
  for (const PassParts<Real>* parts : passes)
    per_ray.push_back(parts->sampler->capacity(1, per_ray.empty() ? 0 : per_ray.back()));
  if (options.tile_rays > 0) return options.tile_rays;
  return std::clamp<std::int64_t>(kTileRows / expected_samples(passes, per_ray), 4, 64);
}

template <class Real>
int lanes_of(const std::vector<const PassParts<Real>*>& passes, const PipelineOptions& options, std::int64_t rays) {
  if (options.lanes > 0) return options.lanes;
  std::vector<std::int64_t> per_ray;
  const std::int64_t tile_rays = tile_rays_of(passes, options, per_ray);
  const std::int64_t tiles = (rays + tile_rays - 1) / tile_rays;
  std::size_t lane_bytes = 0;
  for (const PassParts<Real>* parts : passes) lane_bytes += declared_by(*parts, 1, true).lanes;
  lane_bytes = std::max<std::size_t>(lane_bytes / sizeof(Real) * sizeof(float), 1);
  const auto in_memory = static_cast<std::int64_t>(kLaneBytes / lane_bytes);
  std::int64_t lanes = std::min({kMostLanes, in_memory, rays * expected_samples(passes, per_ray) / kLaneRows});
  if (lanes < tiles && lanes > kEvenLanes) lanes -= lanes % kEvenLanes;
  return static_cast<int>(std::clamp<std::int64_t>(lanes, 1, tiles));
}

template <class Real>
NetworkPlan plan_network(const std::vector<const PassParts<Real>*>& passes, const PipelineOptions& options,
                         std::int64_t rays, int threads, bool trainable, double labelled) {
  NetworkPlan plan;
  std::vector<std::int64_t> per_ray;
  const std::int64_t tile_rays = tile_rays_of(passes, options, per_ray);
  // Threads that get a whole tile; a last one with a part of it counts for that part.
  const double busy = std::clamp(static_cast<double>(rays) / static_cast<double>(tile_rays), 1.0,
                                 static_cast<double>(std::min(options.lanes, threads)));
  const std::size_t terms = options.losses.empty() ? 0 : 2;  // gradients of weight and density
  std::size_t traces = 0, backward = 0, logits = 0;
  for (std::size_t p = 0; p < passes.size(); ++p) {
    const PassParts<Real>& parts = *passes[p];
    plan.tensors += declared_by(parts, options.lanes, trainable);
    const bool learned_position = declared_bytes<Real>(*parts.position, 1, trainable).learns;

    // Of a tile: what forward leaves, and what backward takes beside it.
    const bool ahead = passes.size() == 1 && learned_position;
    const std::size_t samples = size(parts.sampler->capacity(tile_rays, p == 0 ? 0 : per_ray[p - 1]));
    const std::size_t encoded = size(parts.position->traits().out_dims);
    const bool reads =
        (parts.head && (!parts.branch || parts.branch->rules.reads_feature)) ||
        std::any_of(parts.heads.begin(), parts.heads.end(), [](auto& one) { return one.branch->rules.reads_feature; });
    const std::size_t feature = reads ? size(parts.field->traits().feature_dims) : 0;
    const std::size_t hidden = parts.head && !parts.branch ? size(parts.head->hidden_width()) : 0;
    const std::size_t saved = parts.field->saved_bytes(static_cast<std::int64_t>(samples), tile_rays);
    const std::size_t place = 3 * sizeof(double) + 2 * sizeof(Real) + sizeof(std::int32_t);
    const auto semantic = static_cast<std::size_t>(labelled * static_cast<double>(samples * hidden));
    traces += (samples * (6 + feature) + semantic) * sizeof(Real) + saved;
    if (!ahead) traces += samples * (place + encoded * sizeof(Real));
    // Of each ray: encoded direction, colour, depth, opacity and summed hidden activations with their gradients.
    const std::size_t direction = parts.direction ? size(parts.direction->traits().out_dims) : 0;
    traces += size(tile_rays) * (direction + 2 * (5 + hidden)) * sizeof(Real);
    backward = std::max(backward, (samples * (4 + terms + feature) + semantic) * sizeof(Real) +
                                      parts.field->scratch_bytes(static_cast<std::int64_t>(samples), tile_rays));
    // Of corrected cameras: gradients of rays by way of positions, and colours as shown.
    if (options.cameras.poses)
      backward += (samples * (3 + (learned_position ? 0 : encoded)) + size(tile_rays) * 6) * sizeof(Real);
    if (options.cameras.colors) traces += size(tile_rays) * 6 * sizeof(Real);
    // What stands behind branches is done with its backward before that of the pass begins.
    const auto kept = static_cast<std::int64_t>(kKeptShare * static_cast<double>(samples));
    const auto add_branch = [&](const BranchParts<Real>& branch, const Head<Real>& head) {
      const BranchBytes bytes = branch_bytes(branch, head, kept, tile_rays, feature);
      traces += bytes.traces;
      backward = std::max(backward, bytes.backward);
    };
    if (parts.branch) add_branch(*parts.branch, *parts.head);
    for (const HeadParts<Real>& one : parts.heads) {
      add_branch(*one.branch, *one.head);
      traces += size(tile_rays) * 2 * (size(one.head->hidden_width()) + size(one.head->width())) * sizeof(Real);
    }
    if (parts.head) {
      const std::size_t rows = options.rules.deferred_class_layer ? size(tile_rays) : samples;
      logits += 2 * rows * size(parts.head->width()) * sizeof(Real);
    }
    if (learned_position) {
      const std::size_t all = size(parts.sampler->capacity(rays, p == 0 ? 0 : per_ray[p - 1]));
      // Coordinates, encoded rows and their gradients.
      plan.step_rows +=
          all * (place + 2 * encoded * sizeof(Real)) + parts.position->scratch_bytes(static_cast<std::int64_t>(all));
    }
    if (parts.sampler->traits().observes) {
      plan.density += size(threads) * kDensityRows *
                      (3 * sizeof(double) + (encoded + 1) * sizeof(Real) + saved / std::max<std::size_t>(samples, 1));
    }
  }
  const CameraRules& cameras = options.cameras;
  const auto add_table = [&](std::int32_t cols) {
    const CentredTable<Real> table(cameras.count, cols, 1, *passes.front()->stages->cameras);
    plan.tensors += declared_bytes<Real>(table, options.lanes, trainable);
  };
  if (trainable && cameras.poses) add_table(kPoseNumbers);
  if (trainable && cameras.colors) add_table(kColorNumbers);
  plan.activations = static_cast<std::size_t>(busy * static_cast<double>(trainable ? traces + backward : traces));
  plan.logits = static_cast<std::size_t>(busy * static_cast<double>(logits));
  return plan;
}

#define SEMFIELD_INSTANTIATE(Real)                                                                               \
  template std::int64_t tile_rays_of<Real>(const std::vector<const PassParts<Real>*>&, const PipelineOptions&,   \
                                           std::vector<std::int64_t>&);                                          \
  template int lanes_of<Real>(const std::vector<const PassParts<Real>*>&, const PipelineOptions&, std::int64_t); \
  template NetworkPlan plan_network<Real>(const std::vector<const PassParts<Real>*>&, const PipelineOptions&,    \
                                          std::int64_t, int, bool, double);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
