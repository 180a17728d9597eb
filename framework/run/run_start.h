// How a run begins or goes on: its folder and session, and what it writes down before the first step.
#pragma once

#include <optional>

#include "run/run_folder.h"
#include "run/run_resume.h"
#include "run/train_run.h"
#include "session/self_training.h"
#include "session/training.h"

namespace semfield {

struct OpenedForTraining {
  std::optional<RunFolder> folder;  ///< locked; none where the request names none
  Session session;
  SceneInputs inputs;
  ResumePoint point;                       ///< what a Training of the session is to load
  std::optional<TrainOutcome> ended = {};  ///< of a run with nothing left to do; then nothing was written
};

/// Opens the scene and, for a run that goes on, finds its newest checkpoint; makes the folder of a new one when nothing
/// can refuse it any more; writes run.yaml. Findings are reported. Throws Error, and then a new run has left nothing. A
/// request without out_dir gets no folder.
OpenedForTraining open_for_training(RunConfig config, Registry& registry, const TrainRequest& request,
                                    TrainingListener& listener);

/// run.yaml, as the session's configuration is now; nothing is written where the file says so already.
void write_run_config(const RunFolder& folder, const RunConfig& config, Registry& registry);

/// labels.json, with the rounds so far.
void write_label_counts(const RunFolder& folder, const Session& session, const SelfTraining& self_training);

/// classes.yaml, left_out.json and environment.json.
void write_run_records(const RunFolder& folder, Training& training, const Registry& registry, const ResumePoint& point);

}  // namespace semfield
