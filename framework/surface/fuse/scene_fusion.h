// Fusion of a scene's training frames: depth of every frame, fused maps, and their scores against the true labels.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "session/session.h"
#include "surface/fuse/fusion.h"

namespace semfield {

/// One entry per frame of `frames`.
struct FrameMaps {
  std::vector<int> frames;                       ///< indices into LoadedScene::info.frames
  std::vector<std::vector<float>> depth_m;       ///< [H * W] z-depth, 0 = none
  std::vector<std::vector<std::int16_t>> label;  ///< the run's own labels; empty where there are none
};

/// Depth of the training frames as the scene has it. Throws Error(data) where no frame has any.
FrameMaps true_depth(const LoadedScene& scene);

/// The session of a run, and where it lies.
struct TrainedField {
  const Session& session;
  const std::string& run_dir;
};

/// Depth of the same frames rendered from a run's field - expected depth divided by opacity, 0 below `min_opacity` -
/// and its labels, when the run has semantics and the class table of `scene`. Throws Error(data) naming a frame that
/// the run does not know or that stands elsewhere in it. `done` gets the number of frames rendered; may be null.
FrameMaps learned_depth(const TrainedField& run, const LoadedScene& scene, double min_opacity,
                        const std::function<void(int done)>& done);

/// What one method made of all frames.
struct FusionScore {
  std::string method;  ///< monocular, bayesian, average, or field: the run's own rendering
  ConfusionMatrix confusion;
  std::optional<double> views_mean;  ///< predictions per pixel with depth; none for field
};

struct SceneFusion {
  std::vector<FusionScore> scores;  ///< in the order of the methods, then field where the maps have labels
  FusionCounts counts;
};

/// Called for each frame and method in order with the labels of its pixels; `frame` indexes LoadedScene::info.frames.
using OnFused = std::function<void(const std::string& method, int frame, const std::vector<std::int16_t>& label)>;

/// With the tolerance of the scene where `params` leave it open.
FusionParams settled(const FusionParams& params, const LoadedScene& scene);

/// Fuses every frame of `maps`, with settled() parameters. Frames without true labels are fused and not scored.
SceneFusion fuse_scene(const LoadedScene& scene, const TrainingLabels& labels, const FrameMaps& maps,
                       const FusionParams& params, const OnFused& on_fused);

}  // namespace semfield
