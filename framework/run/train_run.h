// A whole training run in its folder: steps, rows, evaluations, checkpoints; started, stopped, killed and
// resumed.
#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "run/run_listener.h"
#include "run/run_scores.h"
#include "session/settings/run_length.h"
#include "session/training.h"

namespace semfield {

struct TrainRequest {
  std::string out_dir;
  bool resume = false;            ///< continue in out_dir from its newest checkpoint that verifies
  std::vector<std::string> keep;  ///< components forced back in
  Ranks* ranks = nullptr;         ///< SessionOptions::ranks
  AskedLength more = {};          ///< with `resume`: what it trains from its checkpoint on; neither: to its end
};

struct TrainOutcome {
  int signal = 0;  ///< the signal that ended the run early, after its checkpoint
  std::int64_t step = 0;
  double train_s = 0;    ///< seconds of training of the whole run
  double trained_s = 0;  ///< of them, those of this call
  std::string run_dir;
  std::string report_path;     ///< "" where the run was stopped or no report was requested
  ScoreValues values;          ///< test split, final evaluation
  ScoredPart scored;           ///< the frames that `values` are of
  std::size_t peak_bytes = 0;  ///< of the process
};

/// A null `listener` hears nothing and never stops the run.
TrainOutcome run_training(RunConfig config, Registry& registry, const TrainRequest& request,
                          RunListener* listener = nullptr);

}  // namespace semfield
