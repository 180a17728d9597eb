// A run that a program drives step by step: a training, its rows, its clicks, and a folder once it has one.
#pragma once

#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "labels/clicks/click_log.h"
#include "run/checkpoint_store.h"
#include "run/metrics_log.h"
#include "run/rows/step_rows.h"
#include "run/run_start.h"
#include "session/self_training.h"

namespace semfield {

struct RunSessionOptions {
  std::string run_dir;            ///< made, or gone on with where `resume`; "": the run has no folder until save()
  bool resume = false;            ///< the configuration is run.yaml of run_dir, with overrides
  std::vector<std::string> keep;  ///< components forced back in
  AskedLength more = {};          ///< TrainRequest::more
};

/// Steps have the bits of `semfield train`, and every verb works on the folder. One thread at a time.
class RunSession {
 public:
  /// Throws as open_session and RunFolder do, and Error(usage) for rounds of self-training without a folder.
  RunSession(RunConfig config, Registry& registry, const RunSessionOptions& options, TrainingListener& listener);

  Training& training() { return training_; }
  const Session& session() const { return training_.session(); }
  /// Where it is, or was last written to; "" for neither.
  std::string run_dir() const { return folder_ ? folder_->path() : saved_in_; }

  /// At least one step and at most `most`: as many as run without waiting in between. A round of self-training that is
  /// due is made first; where `stop` ended it no step is made. Their losses, valid until the next call.
  std::span<const StepLosses> advance(std::int64_t most, const std::function<bool()>& stop);
  /// Training::train_more; run.yaml of the run's folder says so.
  void train_more(const AskedLength& asked);
  /// Training rows so far, as metrics.jsonl has them; of a run that goes on those since.
  const std::vector<MetricsRow>& rows() const { return rows_; }

  /// A checkpoint in the run's folder; `run_dir` is then "" or that folder. A run without one is written to `run_dir`,
  /// which must be empty or one that it was written to before, and nothing of it stays locked: any program may go on
  /// with it there. Returns the checkpoint's path. Throws Error(usage) for no folder or another one, Error(data) where
  /// somebody went on with the folder.
  std::string save(const std::string& run_dir);

  /// Clicks and classes; null where the configuration has neither scene.labels.clicks nor .class_room.
  const Annotations* annotations() const { return annotations_ ? &*annotations_ : nullptr; }
  /// The event is stored and synced, and counts from the next step on. False: an event of this id was there. Throws
  /// Error(usage) for a run without a file of clicks: the configuration names one, or has scene.labels.class_room and
  /// was opened with a folder; else as LabelSession::apply.
  bool apply(const LabelEvent& event);

 private:
  RunSession(OpenedForTraining opened, Registry& registry, TrainingListener& listener);
  void write_records(const RunFolder& folder, const ResumePoint& point);
  std::string write_checkpoint(const RunFolder& folder);
  void write_classes();

  Registry& registry_;
  TrainingListener& listener_;
  std::optional<RunFolder> folder_;
  Training training_;
  SelfTraining self_training_;
  std::optional<StepRows> step_rows_;
  std::vector<MetricsRow> rows_;
  std::optional<MetricsLog> log_;
  std::optional<Annotations> annotations_;
  std::optional<ClickLog> clicks_;
  std::string classes_written_;  // what classes.yaml holds
  std::string saved_in_;         // of a run without a folder
  std::string last_saved_;
};

}  // namespace semfield
