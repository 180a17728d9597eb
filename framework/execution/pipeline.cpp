#include "execution/pipeline.h"

#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <cmath>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "execution/lane_executor.h"
#include "model/optim/adam.h"

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
std::vector<std::int64_t> samples_per_ray(const std::vector<PassParts<Real>>& passes, bool training) {
  std::vector<std::int64_t> per_ray;
  for (const PassParts<Real>& parts : passes)
    per_ray.push_back(parts.sampler->capacity(1, per_ray.empty() ? 0 : per_ray.back(), training));
  return per_ray;
}

}  // namespace

template <class Real>
PipelineOptions settled(PipelineOptions options, const std::vector<PassParts<Real>>& passes) {
  SEMFIELD_CHECK(!passes.empty(), "a pipeline needs a pass");
  const std::vector<std::int64_t> per_ray = samples_per_ray(passes, true);
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
    : per_ray_(samples_per_ray(passes, true)),
      rendered_per_ray_(samples_per_ray(passes, false)),
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

// Whether the numbers of a step are sound.

namespace {

// Of a table the whole gradient, and values and moments of the touched rows of one window: the moments of every touched
// row would cost as much memory traffic as the update. From sound numbers comes nothing else, so what this finds was
// written from outside; a value that is not finite is seen in the encoder's output in any case.
//
// Of rows [row, row + rows).
template <class Real>
Unsound<Real> unsound_of_table(const Tensor<Real>& t, std::int64_t step, std::int64_t row, std::int64_t rows) {
  Unsound<Real> bad = first_unsound<Real>({}, t.view(t.grad).row_range(row, rows), {}, {}, false);
  if (bad.element >= 0) {
    bad.element += row * t.spec.cols;
    return bad;
  }
  const std::int64_t window_rows = (t.spec.rows + kTableWindows - 1) / kTableWindows;
  const std::int64_t begin = std::max(row, step % kTableWindows * window_rows);
  const std::int64_t count = std::min(row + rows, (step % kTableWindows + 1) * window_rows) - begin;
  if (count <= 0) return {};
  const auto window = [&](const AlignedBuffer<Real>& buffer) { return t.view(buffer).row_range(begin, count); };
  bad = first_unsound<Real>(window(t.value), window(t.grad), window(t.moment1), window(t.moment2), true);
  if (bad.element >= 0) bad.element += begin * t.spec.cols;
  return bad;
}

template <class Real>
Unsound<Real> unsound_of_learned(const Tensor<Real>& t, std::int64_t step, std::int64_t row, std::int64_t rows) {
  if (t.spec.role == TensorRole::sparse) return unsound_of_table(t, step, row, rows);
  const auto part = [&](const AlignedBuffer<Real>& buffer) { return t.view(buffer).row_range(row, rows); };
  Unsound<Real> bad = first_unsound<Real>(part(t.value), part(t.grad), part(t.moment1), part(t.moment2), false);
  if (bad.element >= 0) bad.element += row * t.spec.cols;
  return bad;
}

// The elements of a derived or state tensor that a step looks at, as a column; none of a rearranged one, which comes
// anew from learned ones. Of a large one (the cells of a fine occupancy grid) they are a window, so that the check
// costs the same for any grid; the sampler itself refuses what it would write.
struct StateWindow {
  std::int64_t begin, count;
};
template <class Real>
StateWindow state_window(const Tensor<Real>& t, std::int64_t step) {
  constexpr std::int64_t kWindow = std::int64_t{1} << 18;
  if (t.spec.role == TensorRole::rearranged) return {0, 0};
  const std::int64_t begin = step % ((t.size() + kWindow - 1) / kWindow) * kWindow;
  return {begin, std::min(kWindow, t.size() - begin)};
}

template <class Real>
std::int64_t checked_rows(const Tensor<Real>& t, std::int64_t step) {
  return t.learned() ? t.spec.rows : state_window(t, step).count;
}

// Of the checked rows [row, row + rows).
template <class Real>
Unsound<Real> unsound_of(const Tensor<Real>& t, std::int64_t step, std::int64_t row, std::int64_t rows) {
  if (t.learned()) return unsound_of_learned(t, step, row, rows);
  const std::int64_t begin = state_window(t, step).begin + row;
  const std::int64_t at = first_non_finite<Real>(View<const Real>(t.value.data() + begin, rows, 1));
  return at < 0 ? Unsound<Real>() : Unsound<Real>{"value", begin + at, t.value.data()[begin + at]};
}

// Of all tensors at once; which one it is, require_sound says.
template <class Real>
bool all_sound(const std::vector<Tensor<Real>>& tensors, std::int64_t step) {
  std::atomic<bool> sound{true};
  const auto tensor = [&](int i) -> const Tensor<Real>& { return tensors[static_cast<std::size_t>(i)]; };
  for_ranges(
      static_cast<int>(tensors.size()), [&](int i) { return checked_rows(tensor(i), step); },
      [&](int i) { return tensor(i).learned() ? tensor(i).spec.cols : 1; },
      [&](int i, std::int64_t row, std::int64_t rows) {
        if (unsound_of(tensor(i), step, row, rows).element >= 0) sound = false;
      });
  return sound;
}

}  // namespace

template <class Real>
std::string element_text(const Tensor<Real>& tensor, std::int64_t element) {
  return fmt::format("row {}, column {}", element / tensor.spec.cols, element % tensor.spec.cols);
}

template <class Real>
void Pipeline<Real>::require_sound(std::int64_t step, const StepLosses& losses) const {
  const bool sound = all_sound(store_.all(), step);
  for (const Tensor<Real>& t : store_.all()) {
    if (sound || !t.learned()) continue;
    const Unsound<Real> bad = unsound_of(t, step, 0, checked_rows(t, step));
    if (bad.element < 0) continue;
    throw Error(ErrorKind::failure, "train.gradient.not_finite",
                fmt::format("the {} of '{}' at {} is {:.6g} (loss {:.6g})", bad.array, t.name,
                            element_text(t, bad.element), bad.found, losses.total),
                std::string(fault_remedy()));
  }
  if (!std::isfinite(losses.total)) {
    std::string listed;
    const std::vector<LossEntry>& entries = options_.losses.entries();
    for (std::size_t i = 0; i < entries.size(); ++i) listed += fmt::format(", {} {}", entries[i].type, losses.terms[i]);
    throw Error(
        ErrorKind::failure, "train.loss.not_finite",
        fmt::format("the loss is {} (colour {}, semantic {}{})", losses.total, losses.color, losses.semantic, listed),
        std::string(fault_remedy()));
  }
  for (const Tensor<Real>& t : store_.all()) {
    if (sound || t.learned()) continue;
    const Unsound<Real> bad = unsound_of(t, step, 0, checked_rows(t, step));
    if (bad.element < 0) continue;
    throw Error(ErrorKind::failure, "train.tensor.not_finite",
                fmt::format("'{}' holds {} at {}", t.name, bad.found, element_text(t, bad.element)),
                std::string(fault_remedy()));
  }
}

template <class Real>
std::string Pipeline<Real>::suspect_tensor() const {
  constexpr Real kProportion = 1e10;
  Real largest = kProportion;
  std::string text;
  for (const Tensor<Real>& t : store_.all()) {
    if (t.spec.role == TensorRole::rearranged) continue;
    const std::int64_t bad = first_non_finite<Real>(t.view(t.value));
    if (bad >= 0) return fmt::format("'{}' holds {} at {}", t.name, t.value.data()[bad], element_text(t, bad));
    for (std::int64_t i = 0; i < t.size() && t.spec.role != TensorRole::state; ++i) {
      const Real value = t.value.data()[i];
      if (!(std::abs(value) > largest)) continue;
      largest = std::abs(value);
      text = fmt::format("the largest value is {:.6g} in '{}' at {}", value, t.name, element_text(t, i));
    }
  }
  return text;
}

template std::string element_text(const Tensor<float>&, std::int64_t);
template std::string element_text(const Tensor<double>&, std::int64_t);
template class Pipeline<float>;
template class Pipeline<double>;
template PipelineOptions settled<float>(PipelineOptions, const std::vector<PassParts<float>>&);
template PipelineOptions settled<double>(PipelineOptions, const std::vector<PassParts<double>>&);

}  // namespace semfield
