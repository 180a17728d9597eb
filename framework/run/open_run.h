// A run that was trained, opened again for evaluation and rendering.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "session/session.h"

namespace semfield {

/// Opens a finished or interrupted run for evaluation and rendering: run.yaml, scene, newest checkpoint.
struct OpenedRun {
  Session session;
  std::int64_t step = 0;
  double train_s = 0;
  std::string run_dir;
};
enum class OpenFor { evaluation, evaluation_of_training_frames, rendering, objects };
/// `ranks`: SessionOptions::ranks. For rendering alone no pixel is read, unless the checkpoint does not state what
/// training knew of the scene.
OpenedRun open_run(const std::string& run_dir, const std::vector<std::string>& overrides, Registry& registry,
                   Diagnostics& diagnostics, OpenFor purpose = OpenFor::evaluation, Ranks* ranks = nullptr);

}  // namespace semfield
