// From configuration, scene and plan to a pipeline: traits are wired here and mismatches named.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "config/settings/choices.h"
#include "config/settings/run_config.h"
#include "core/view.h"
#include "execution/device_library.h"
#include "execution/pipeline.h"
#include "execution/ranks/ranks.h"
#include "labels/clicks.h"
#include "model/leave_out.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"

namespace semfield {

/// What the plan needs to know of the config, and of the sampler of its last pass (make_last_sampler).
BuildRequest build_request(const RunConfig& config, const Registry& registry, const SamplerTraits& last_sampler);

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

/// The sampler of the last pass, which every plan keeps: the plan asks for its traits before a network is built.
std::unique_ptr<Sampler<float>> make_last_sampler(const RunConfig& config, const Registry& registry,
                                                  const SceneExtent& extent);

/// A network before its tensors are allocated: the parts of its passes for one device, built once. What depends on them
/// is asked of them.
template <class Real>
struct NetworkParts {
  std::vector<PassParts<Real>> passes;
  PipelineOptions options;  ///< without class weights

  /// Whether a position encoder lives in the unit cube: rays must then be clipped to the bounds.
  bool needs_bounds() const;
};

/// `last`, where given, becomes the sampler of the last pass; it was made for the same `extent`. Throws Error(config)
/// naming parts that do not go together. Real = float trains and renders; double is the oracle of the tests.
template <class Real>
NetworkParts<Real> make_parts(const RunConfig& config, const Registry& registry, const BuildPlan& plan,
                              const SceneExtent& extent, std::unique_ptr<Sampler<Real>> last = {});

/// The pipeline of the parts. `class_weight` [C logits] or empty.
template <class Real>
std::unique_ptr<Pipeline<Real>> assemble(NetworkParts<Real> parts, std::vector<float> class_weight, bool trainable);

/// How a pipeline runs on a device.
struct RunOn {
  DeviceId device;  ///< that chosen_device gave
  bool trainable = true;
  Ranks* ranks = nullptr;  ///< whose devices run it too: they call run_on together
  Diagnostics* diagnostics =
      nullptr;  ///< gets a finding for each field that is slower than other settings of it would be
};

/// From now on `pipeline` trains and renders on the device. The CPU runs the parts that the pipeline has; another
/// device gets parts of its own.
void run_on(const RunOn& how, const RunConfig& config, const Registry& registry, const BuildPlan& plan,
            const SceneExtent& extent, Pipeline<float>& pipeline);

// Wide channels of a dataset, learned by their principal axes: found once, kept with the network, and applied to the
// training frames.

struct Session;

/// The `width` directions that keep most of the rows' dot products: eigenvectors of the mean of f f^T over rows f of
/// unit length, largest first, about the origin and not about the mean, so that angles stay what they were. Returns
/// [cols, width] with orthonormal columns, whose largest element is positive. At most 65,536 cells are looked at,
/// evenly spaced. Throws Error(data) where no frame has a row that is not zero.
std::vector<float> principal_axes(const std::vector<const FrameChannel*>& maps, std::int32_t width);
/// The rows of `map` become their coordinates: row times matrix [map.cols, width].
void multiply_rows(FrameChannel& map, View<const float> matrix);

/// Finds the axes of the heads that learn fewer columns than their channel has, puts them into the network's state and
/// the channels of the training frames onto them. False where no head has any.
bool settle_axes(Session& session);
/// After a checkpoint has replaced the state: the frames' channels, which lie on the axes `before` in the order of the
/// session's heads, go onto those of the checkpoint.
void follow_axes(Session& session, const std::vector<std::vector<float>>& before);
/// The axes in the network's state, one for each head of the session; empty for heads that have none.
std::vector<std::vector<float>> axes_of(const Session& session);

// Whether a scene's classes are still those that a network was trained with.

/// Throws Error(data) with the first id that `trained`, a table as YAML, and `now` do not agree in; colours do not
/// count. Labels would be shifted without a word. Classes that `clicks` gave names to may have had another one, or
/// none: they are told by their place.
void require_class_table(const std::string& trained, const ClassTable& now,
                         const std::optional<Annotations>& clicks = {});

}  // namespace semfield
