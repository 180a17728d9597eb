// Runs that are opened again, to go on or to be looked at: what of them is compared with the checkpoint, and poses
// that are learned or fitted to a field.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "config/explain.h"
#include "config/settings/run_config.h"
#include "core/error.h"
#include "plugin/registry.h"
#include "train/checkpoint.h"
#include "train/run_folder.h"
#include "train/session.h"

namespace semfield {

struct TrainOutcome;

/// Where a run that goes on begins.
struct ResumePoint {
  std::optional<CheckpointFacts> facts;   ///< of the newest checkpoint that verifies; none: the run begins at step 0
  std::string path;                       ///< of that checkpoint
  std::vector<ConfigDifference> changed;  ///< settings that are others than before, and may be
  std::int64_t step() const { return facts ? facts->step : 0; }
};

/// Compares `config` with what the checkpoint was trained with, or with run.yaml where there is none. Throws
/// Error(config) naming every setting that would make it another run, Error(data) for a bad checkpoint.
ResumePoint find_resume_point(const RunFolder& folder, const RunConfig& config, Registry& registry,
                              Diagnostics& diagnostics);
/// What the run in `folder` came to, from its files, where the checkpoint that it goes on from is of its last step,
/// that step was scored, the page about it is there, and no setting changes. None: it has to be gone on with, if only
/// to be scored.
std::optional<TrainOutcome> ended_run(const RunFolder& folder, const RunConfig& config, const ResumePoint& point);
/// Warns of other inputs, labels and modules than the checkpoint's; Error(data) where classes have changed places.
void compare_with_training(const CheckpointFacts& facts, const SceneInputs& inputs, const Session& session,
                           Diagnostics& diagnostics);

/// Opens a finished or interrupted run for evaluation and rendering: run.yaml, scene, newest checkpoint.
struct OpenedRun {
  Session session;
  std::int64_t step = 0;
  double train_s = 0;
  std::string run_dir;
};
enum class OpenFor { evaluation, evaluation_of_training_frames, rendering, objects, surface };
/// `ranks`: SessionOptions::ranks. A surface needs the pixels of photographs. For rendering alone no pixel is read,
/// unless the checkpoint does not state what training knew of the scene.
OpenedRun open_run(const std::string& run_dir, const std::vector<std::string>& overrides, Registry& registry,
                   Diagnostics& diagnostics, OpenFor purpose = OpenFor::evaluation, Ranks* ranks = nullptr);

// Poses that are not those given: of training frames, as a run has learned them; of others, fitted to a field that
// stays as it is. Where held-out cameras are given wrongly too, scores at their given poses say little of the field.

/// Training frames of a session that was opened again get the poses that the checkpoint of its run has learned, with a
/// note of how far they lie from those given. Nothing happens where the run believed its poses.
void use_learned_poses(Session& session, const TensorFile& checkpoint, Diagnostics& diagnostics);

struct PoseRefinement {
  std::int64_t steps = 300;
  std::int64_t rays = 4096;     ///< of all frames together
  double learning_rate = 1e-3;  ///< radians and shares of the scene's half size; it falls to a tenth
};

/// Poses of `frames` under which the session's field shows their photographs best, by the colour loss alone; the same
/// for a seed. The session has tensors of a run, whose colours it knows. Throws Error.
std::vector<Pose> refine_poses(Session& session, Registry& registry, const std::vector<int>& frames,
                               const PoseRefinement& how = {});

}  // namespace semfield
