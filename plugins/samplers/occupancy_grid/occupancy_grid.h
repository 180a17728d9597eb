// The occupancy-grid sampler: fixed steps along the ray, empty cells left out [Mueller22].
#pragma once

#include <string>

#include "config/params.h"
#include "core/error.h"
#include "plugin/kernels.h"
#include "plugin/sampler.h"
#include "samplers/occupancy_grid/occupancy_grid_kernels.h"

namespace semfield {

/// How empty cells are passed over.
///   certified  only while the optical depth passed over on a ray, by the grid's bounds, stays within the budget:
///   colour and
///              opacity are off by at most the budget. A fixed threshold a step has no such bound: 64 steps of 0.01
///              hide 47 %.
///   threshold  every cell below the threshold is passed over.
///   never      every step is evaluated: what the other two are compared with.
enum class SkipRule : std::uint8_t { certified, threshold, never };

SEMFIELD_CHOICES(SkipRule, "certified", "threshold", "never");

struct OccupancyGridParams {
  std::int64_t resolution = 128;
  std::int64_t cascades = 1;
  std::int64_t max_samples = 256;
  double step_m = 0;
  double growth = 0;
  SkipRule skip = SkipRule::certified;
  double skip_budget = 1e-3;
  double training_skip_budget = 0.02;
  bool keep_last = false;
  double threshold = 0.01;
  double decay = 0.95;
  std::int64_t update_every = 16;
  std::int64_t warmup_steps = 256;
  double update_share = 0.125;
};

void describe(ParamVisitor& visit, OccupancyGridParams& params);
void choose_for(OccupancyGridParams& params, Device device, std::vector<std::string>& chosen);
void validate(const OccupancyGridParams& params, Diagnostics& diagnostics);

/// State: `density` [cells, 1], the decayed maximum of the density seen in each cell (-1: never seen), an estimate of
/// the cell's bound, as good as the points that were drawn in it; and what sample() reads, made from it by observe():
/// `empty_bits`, `block_bound` and `summary` (layouts in occupancy_grid_kernels.h). Cells are numbered
/// ((cascade * n + z) * n + y) * n + x. Until the warm-up is over every cell counts as occupied, so that no random
/// start decides what is never looked at.
template <class Real>
class OccupancyGrid final : public Sampler<Real> {
 public:
  OccupancyGrid(const OccupancyGridParams& params, const SamplerBuild& build, const KernelTables& kernels);
  SamplerTraits traits() const noexcept override {
    SamplerTraits traits;
    traits.single_pass = true;
    traits.observes = true;
    traits.keeps_to_room = true;
    traits.empty_space = params_.skip == SkipRule::certified   ? EmptySpace::certified
                         : params_.skip == SkipRule::threshold ? EmptySpace::threshold
                                                               : EmptySpace::sampled;
    return traits;
  }
  std::int64_t capacity(std::int64_t rays, std::int64_t, bool training) const noexcept override {
    return rays * most_samples(training);
  }
  void declare(ParamDeclarer& declarer) const override {
    declarer.tensor({"density", geometry_.cells(), 1, Init::constant(-1), TensorRole::state});
    declarer.tensor({"empty_bits", geometry_.cells() / kBitsPerElement, 1, Init::constant(1), TensorRole::state});
    declarer.tensor({"block_bound", geometry_.blocks(), 1, Init::constant(kUnbounded), TensorRole::state});
    declarer.tensor({"summary", 3, 1, Init::constant(0), TensorRole::state});
  }
  void observe(const StepContext& ctx, const Tensors<Real>& tensors, const DensityQuery<Real>& query) const override;
  const OccupancyGeometry& geometry() const { return geometry_; }

 protected:
  /// Per ray. One that needs more takes longer steps than its neighbours, and a picture shows the border: rendering,
  /// which waits for no gradients, gives rays more (docs/decisions.md, 0053).
  std::int64_t most_samples(bool training) const noexcept {
    constexpr std::int64_t kTimes = 4, kEnough = 512;
    const std::int64_t most = params_.max_samples;
    return training ? most : std::max(most, std::min(kTimes * most, kEnough));
  }
  void do_sample(const StepContext& ctx, const Tensors<Real>& tensors, const Rays<Real>& rays,
                 const Proposal<Real>* previous, Samples<Real>& out) const override;

 private:
  const OccupancyGridKernels<Real>* kernels_;
  OccupancyGridParams params_;
  OccupancyGeometry geometry_;
};

extern template class OccupancyGrid<float>;
extern template class OccupancyGrid<double>;

}  // namespace semfield
