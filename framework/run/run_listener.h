// Who gets a run's progress, and is checked between steps.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "eval/evaluator.h"
#include "session/training.h"

namespace semfield {

class RunFolder;
class ReportFrames;
struct MetricsRow;

/// Which part of a split an evaluation scored.
struct ScoredPart {
  std::int64_t frames = 0, of = 0;
  std::int32_t stride = 1;
  bool whole() const { return frames == of && stride == 1; }
  /// "4 of 30 frames", "all 30 frames at 1 pixel in 4".
  std::string text() const;
};

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

/// What a run reports, and what it checks between steps; every call comes from the thread that trains.
class RunListener : public TrainingListener {
 public:
  virtual void progress(const TrainProgress&) {}
  /// A row for metrics.jsonl is made, whether or not the run has a folder.
  virtual void row(const MetricsRow&) {}
  virtual void scoring(const ScoreProgress&) {}  ///< an evaluation or a round of self-training is under way
  /// 0, or the number of the signal that requests an orderly end.
  virtual int stop_signal() { return 0; }
  /// Whether a checkpoint was requested since the last call.
  virtual bool save_request() { return false; }
  /// true: from now on a stop waits for the step under way and its checkpoint; false: nothing is left to save, so the
  /// process may end at once.
  virtual void stop_waits(bool) {}
  /// A clock for what evaluations take; it never runs back.
  virtual double now_s();
  /// Writes the report of a run that came to its end and returns its path (report/report.h); "": there is none.
  virtual std::string write_report(const RunFolder&, const Session&, const ReportFrames&) { return ""; }
};

}  // namespace semfield
