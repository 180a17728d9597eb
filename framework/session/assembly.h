// From configuration, scene and plan to a pipeline: traits are wired here and mismatches named.
#pragma once

#include <memory>

#include "execution/device_library.h"
#include "execution/network_plan.h"
#include "execution/pipeline.h"
#include "model/leave_out.h"
#include "ranks/ranks.h"
#include "settings/device_choice.h"
#include "settings/run_config.h"

namespace semfield {

/// What the plan needs to know of the config.
BuildRequest build_request(const RunConfig& config, const Registry& registry);

/// Facts of the scene that components may size themselves by.
struct SceneExtent {
  Box bounds;
  double near_m = 0, far_m = 0;
  double pixel_footprint_m = 0;
  bool contracted = false;  ///< rendering.outside
};

/// The extent that `config` was resolved to: its bounds, near and far are written out.
SceneExtent extent_of(const RunConfig& config, double pixel_footprint_m);

/// Lets position encoders replace what they choose from the scene by numbers; "passes.NAME.position: sentence" each.
std::vector<std::string> choose_from_scene(RunConfig& config, const SceneExtent& extent, Device device);

/// True when a position encoder of the plan's passes lives in the unit cube: rays must then be clipped to the bounds.
bool needs_bounds(const RunConfig& config, const Registry& registry);

/// What the pipeline will hold, before it is assembled: steps of train.rays rays on thread_count() threads.
NetworkPlan plan_network(const RunConfig& config, const Registry& registry, const BuildPlan& plan,
                         const SceneExtent& extent, bool trainable);

/// runtime.lanes, or where it is 0 the number that the run gets; for run.yaml.
int lanes_of(const RunConfig& config, const Registry& registry, const BuildPlan& plan, const SceneExtent& extent);

/// Real = float trains and renders; double is the oracle of the tests. `class_weight` [C logits] or empty.
template <class Real>
std::unique_ptr<Pipeline<Real>> assemble(const RunConfig& config, const Registry& registry, const BuildPlan& plan,
                                         const SceneExtent& extent, std::vector<float> class_weight, bool trainable);

/// A finding for each field that computes more slowly on `device` than other settings of it would.
void say_slow_fields(const RunConfig& config, const Registry& registry, const BuildPlan& plan,
                     const SceneExtent& extent, DeviceId device, Diagnostics& diagnostics);

/// From now on `pipeline` trains and renders on `device`, which chosen_device gave, and with it on those of all `ranks`
/// where these are given: they call this together.
void run_on(DeviceId device, const RunConfig& config, const Registry& registry, const BuildPlan& plan,
            const SceneExtent& extent, Pipeline<float>& pipeline, bool trainable, Ranks* ranks = nullptr);

extern template std::unique_ptr<Pipeline<float>> assemble<float>(const RunConfig&, const Registry&, const BuildPlan&,
                                                                 const SceneExtent&, std::vector<float>, bool);
extern template std::unique_ptr<Pipeline<double>> assemble<double>(const RunConfig&, const Registry&, const BuildPlan&,
                                                                   const SceneExtent&, std::vector<float>, bool);

}  // namespace semfield
