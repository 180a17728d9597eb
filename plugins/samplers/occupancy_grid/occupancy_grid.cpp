// Parameters, traits, state and registration of the occupancy-grid sampler.
#include "samplers/occupancy_grid/occupancy_grid.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void bad_density(const double* position, double sigma) {
  throw Error(ErrorKind::failure, "train.density.invalid",
              "sampler 'occupancy_grid': density at (" + std::to_string(position[0]) + ", " +
                  std::to_string(position[1]) + ", " + std::to_string(position[2]) + ") is " + std::to_string(sigma) +
                  "; it must be finite and not negative",
              "lower the learning rate, or go back to the last checkpoint");
}
namespace {

// docs/decisions.md, 0036. Where steps grow, a ray passes all of space; else one that keeps its last sample ends at a
// wall.
struct SamplesOn {
  std::int64_t cpu, gpu;
};
constexpr SamplesOn kOpen{128, 256}, kGrowing{128, 512}, kEnclosed{48, 128};

constexpr double kPadding = 0.01;  // of the longest side: walls lie on the bounds and must not lie on the grid's faces
constexpr double kLeastSide = 0.02;    // of the longest side: a flat scene still gets cells with volume
constexpr double kStepsAcross = 1024;  // steps along the diagonal of a cube [Mueller22 App. E.1]

OccupancyGeometry make_geometry(const OccupancyGridParams& params, const SamplerBuild& build) {
  if (build.bounds.empty()) {
    throw Error(ErrorKind::config, "scene.bounds.unknown",
                "sampler 'occupancy_grid' needs the bounds of the scene, and they are unknown",
                "set the scene's bounds, or use the stratified sampler");
  }
  const Vec3d side = build.bounds.size(), center = build.bounds.center();
  const double longest = std::max({side.x, side.y, side.z});
  if (!(longest > 0) || !std::isfinite(longest)) {
    throw Error(ErrorKind::config, "scene.bounds.unknown",
                "sampler 'occupancy_grid': the bounds of the scene are a point or not finite",
                "set the scene's bounds, or use the stratified sampler");
  }
  OccupancyGeometry g;
  g.n = static_cast<std::int32_t>(params.resolution);
  g.cascades = static_cast<std::int32_t>(params.cascades);
  for (int i = 0; i < 3; ++i) {
    const double padded = std::max(side[i], kLeastSide * longest) + 2 * kPadding * longest;
    g.lo[i] = center[i] - 0.5 * padded;
    g.cell_m[i] = padded / static_cast<double>(g.n);
  }
  g.step_m = params.step_m > 0 ? params.step_m : std::sqrt(3.0) * longest / kStepsAcross;
  g.equal_m = params.growth > 0 ? g.step_m / params.growth : 0;
  return g;
}

template <class Real>
OccupancyState<Real> state_of(const Tensors<Real>& tensors) {
  return {tensors.value[0].data, tensors.value[1].data, tensors.value[2].data, tensors.value[3].data};
}

}  // namespace

void describe(ParamVisitor& visit, OccupancyGridParams& params) {
  SEMFIELD_PARAM(visit, params, resolution, "cells per side of the grid, a multiple of 32 [Mueller22 App. E.2]",
                 {32, 512});
  SEMFIELD_PARAM(visit, params, cascades,
                 "nested grids, each twice the size of the one before; nothing is outside the last", {1, 8});
  SEMFIELD_PARAM(visit, params, max_samples,
                 "most samples per ray in training; a ray that needs more takes longer steps; rendering allows four "
                 "times as many, up to 512; 0 = by the device",
                 {0, 65536});
  SEMFIELD_PARAM(visit, params, step_m, "step along the ray in metres; 0 = sqrt(3) / 1024 of the scene's longest side",
                 {0, 1e12});
  SEMFIELD_PARAM(
      visit, params, growth,
      "largest length of a step as a share of its distance from the camera, so that far steps double whenever the "
      "distance does [Mueller22 App. E.1]; 0 = equal steps",
      {0, 1});
  SEMFIELD_PARAM(visit, params, skip, "how empty cells are passed over: certified (bounded error), threshold or never");
  SEMFIELD_PARAM(visit, params, skip_budget, "optical depth that a ray may lose to skipping when rendering (certified)",
                 {0, 1});
  SEMFIELD_PARAM(visit, params, training_skip_budget, "the same when training", {0, 1});
  SEMFIELD_PARAM(visit, params, keep_last,
                 "always keep the last step of a ray, which takes the remaining light under rendering.far: background");
  SEMFIELD_PARAM(
      visit, params, threshold,
      "optical depth of a step above which a cell is occupied; half the grid's mean density when that is less",
      {0, 10});
  SEMFIELD_PARAM(visit, params, decay, "decay of a cell's density per update [Mueller22 App. E.2]", {0, 1});
  SEMFIELD_PARAM(visit, params, update_every, "steps from update to update [Mueller22 App. E.2]", {1, 1000000});
  SEMFIELD_PARAM(visit, params, warmup_steps, "steps in which every cell is updated and none is skipped", {0, 1000000});
  SEMFIELD_PARAM(visit, params, update_share, "share of the cells that an update after the warm-up draws", {0.001, 1});
}

void validate(const OccupancyGridParams& params, Diagnostics& diagnostics) {
  if (params.resolution % 32 != 0) {
    const std::int64_t near = std::clamp<std::int64_t>((params.resolution + 16) / 32 * 32, 32, 512);
    diagnostics.error("config.value.range", "resolution",
                      "must be a multiple of 32, got " + std::to_string(params.resolution),
                      "use " + std::to_string(near));
  }
}

void choose_for(OccupancyGridParams& params, Device device, std::vector<std::string>& chosen) {
  if (params.max_samples != 0) return;
  const SamplesOn& on = params.growth > 0 ? kGrowing : params.keep_last ? kEnclosed : kOpen;
  params.max_samples = device == Device::cpu ? on.cpu : on.gpu;
  chosen.push_back("max_samples was set to " + std::to_string(params.max_samples) + ", which suits a " +
                   (device == Device::cpu ? "CPU" : "GPU"));
}

template <class Real>
OccupancyGrid<Real>::OccupancyGrid(const OccupancyGridParams& params, const SamplerBuild& build,
                                   const KernelTables& kernels)
    : kernels_(&kernels.get<OccupancyGridKernels<Real>>(build.device, "sampler 'occupancy_grid'")),
      params_(params),
      geometry_(make_geometry(params, build)) {
  std::vector<std::string> chosen;  // said by whoever asked for the choice before
  choose_for(params_, build.device, chosen);
}

template <class Real>
void OccupancyGrid<Real>::do_sample(const StepContext& ctx, const Tensors<Real>& tensors, const Rays<Real>& rays,
                                    const Proposal<Real>*, Samples<Real>& out) const {
  OccupancySampleArgs args;
  args.geometry = geometry_;
  args.max_samples = most_samples(ctx.training);
  args.keep_last = params_.keep_last;
  args.skip_budget = params_.skip == SkipRule::threshold ? std::numeric_limits<double>::infinity()
                     : params_.skip == SkipRule::never   ? -1  // affords nothing, not even exact vacuum
                     : ctx.training                      ? params_.training_skip_budget
                                                         : params_.skip_budget;
  args.jitter = ctx.training;
  args.random = ctx.random("sampler/occupancy_grid");
  args.first_ray = ctx.first_ray;
  args.workspace = ctx.workspace;
  kernels_->sample(args, state_of(tensors), rays, out);
}

template <class Real>
void OccupancyGrid<Real>::observe(const StepContext& ctx, const Tensors<Real>& tensors,
                                  const DensityQuery<Real>& query) const {
  if (ctx.step % params_.update_every != 0) return;
  const bool warm_up = ctx.step < params_.warmup_steps;
  OccupancyUpdateArgs args;
  args.geometry = geometry_;
  args.parts = warm_up ? 1 : std::max<std::int64_t>(1, std::llround(1.0 / params_.update_share));
  args.part = ctx.step / params_.update_every % args.parts;
  // A cell that is drawn in every parts-th update loses as much between draws as one that is drawn in each.
  args.decay = std::pow(params_.decay, static_cast<double>(args.parts));
  args.threshold = params_.threshold;
  args.random = ctx.random("sampler/occupancy_grid/observe");
  args.workspace = ctx.workspace;
  const OccupancyState<Real> state = state_of(tensors);
  kernels_->update(args, state, query);
  if (ctx.step + params_.update_every >= params_.warmup_steps) kernels_->publish(args, state);
}

template class OccupancyGrid<float>;
template class OccupancyGrid<double>;

SEMFIELD_PLUGIN_MODULE(occupancy_grid, "1.0", [](Registry& registry) {
  occupancy_grid_kernels(registry.kernels());
  registry.add_sampler<OccupancyGrid, OccupancyGridParams>(
      "occupancy_grid", "Fixed steps along the ray that leave out cells known to be empty; one pass suffices.");
})

}  // namespace semfield
