// What a training run scores: a sample of test frames now and then, the whole split and training frames at its end.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "train/metrics_log.h"
#include "train/run_folder.h"
#include "train/run_report.h"
#include "train/session.h"
#include "train/tensorboard.h"

namespace semfield {

/// The run's files that scores go into.
struct ScoreFiles {
  const RunFolder& folder;
  MetricsLog& log;
  EventWriter& events;
};

struct ScoreHooks {
  std::function<void(const std::string&)> note;
  std::function<int()> stop_signal;  ///< asked between frames of a sample; may be null
};

using ScoreValues = std::vector<std::pair<std::string, std::optional<double>>>;

class RunScores {
 public:
  /// Everything given must outlive the object.
  RunScores(const Session& session, const ScoreFiles& files, ScoreHooks hooks)
      : session_(session), files_(files), hooks_(std::move(hooks)) {}

  /// The state of training that is scored.
  struct Moment {
    std::int64_t step = 0;
    double train_s = 0;
  };
  /// A row of metrics.jsonl for `report.eval_frames` test frames; none when a stop came between them.
  void score_sample(const Moment& at);
  /// Every test frame: a row, final_eval.json and the report's frames. Without test frames no values.
  ScoreValues score_test_frames(const Moment& at);
  /// A row of split "train": the field at the training poses against the scene's own labels, then the labels given.
  void score_training_frames(const Moment& at);

  std::optional<double> last_miou() const { return last_miou_; }
  const ReportFrames& report_frames() const { return report_frames_; }

 private:
  SplitScore score(const EvalJob& job) const;
  MetricsRow row_of(const Moment& at, const std::string& split, const SplitScore& score) const;
  // The row of test frames, also as events.
  void log_test(MetricsRow row, const SplitScore& score);

  const Session& session_;
  ScoreFiles files_;
  ScoreHooks hooks_;
  std::optional<double> last_miou_;
  ReportFrames report_frames_;
};

/// Seconds since 1970, for events.
double unix_seconds();

}  // namespace semfield
