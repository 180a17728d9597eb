// A whole training run in its folder: steps, rows, evaluations, checkpoints; started, stopped, killed and
// resumed.
#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "run/run_scores.h"
#include "session/training.h"
#include "settings/run_config.h"

namespace semfield {

struct TrainProgress {
  std::int64_t step = 0, steps = 0;
  double loss = 0;
  std::vector<std::pair<std::string, double>> terms;  ///< of the list `losses` that have begun, before their weights
  double psnr = 0;                                    ///< of the training rays since the last progress
  std::optional<double> miou_present;                 ///< of the last evaluation
  ScoredPart scored;                                  ///< which scored these test frames
  double rays_per_s = 0;
  double train_s = 0;      ///< seconds of training, evaluation not counted
  double remaining_s = 0;  ///< estimate
};

/// What a run tells, and what it asks between steps; every call comes from the thread that trains.
class RunListener : public TrainingListener {
 public:
  virtual void progress(const TrainProgress&) {}
  virtual void scoring(const ScoreProgress&) {}  ///< an evaluation or a round of self-training is under way
  /// 0, or the number of the signal that asks for an orderly end.
  virtual int stop_signal() { return 0; }
  /// Whether a checkpoint was asked for since the last call.
  virtual bool save_request() { return false; }
  /// true: from now on a stop waits for the step under way and its checkpoint; false: nothing is left to save, so the
  /// process may end at once.
  virtual void stop_waits(bool) {}
  /// A clock for what evaluations take; it never runs back.
  virtual double now_s();
  /// Writes the report of a run that came to its end and returns its path (report/run_report.h); "": there is none.
  virtual std::string write_report(const RunFolder&, const Session&, const ReportFrames&) { return ""; }
};

struct TrainRequest {
  std::string out_dir;
  bool resume = false;            ///< go on in out_dir from its newest checkpoint that verifies
  std::vector<std::string> keep;  ///< components forced back in
};

struct TrainOutcome {
  int signal = 0;  ///< the signal that ended the run early, after its checkpoint
  std::int64_t step = 0;
  double train_s = 0;
  std::string run_dir;
  std::string report_path;     ///< "" where the run was stopped or no report was asked for
  ScoreValues values;          ///< test split, final evaluation
  ScoredPart scored;           ///< the frames that `values` are of
  std::size_t peak_bytes = 0;  ///< of the process
};

/// A null `listener` hears nothing and never stops the run.
TrainOutcome run_training(RunConfig config, Registry& registry, const TrainRequest& request,
                          RunListener* listener = nullptr);

}  // namespace semfield
