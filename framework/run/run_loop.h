// Train a run in slices: steps, rows, rounds of self-training, scores and checkpoints in one loop that every driver
// uses.
#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <optional>
#include <span>
#include <string>

#include "run/checkpoint_store.h"
#include "run/metrics_log.h"
#include "run/rows/step_rows.h"
#include "run/run_listener.h"
#include "run/run_scores.h"
#include "run/run_start.h"
#include "session/self_training.h"

namespace semfield {

/// What may happen between steps in addition to the rows of metrics.jsonl, and what ends training.
struct RunLoopOptions {
  bool scores = false;     ///< evaluations every report.eval_every_s and events for TensorBoard; needs a folder
  bool saves = false;      ///< checkpoints every report.checkpoint_every_s and on request; needs a folder
  bool rounds = true;      ///< rounds of self-training, and labels.json
  bool rows_wait = false;  ///< advance() leaves rows to write_rows() and save(), so a full disk does not end training
};

/// One thread at a time. The command line advances it to the end, Python by the steps that a program names, and the
/// labelling page by slices of time; the bits are the same.
class RunLoop {
 public:
  /// Takes up the checkpoint of `opened.point`, if any, and writes the run's records into its folder, if any.
  /// `registry` and `listener`, which may be null, must outlive the object.
  RunLoop(OpenedForTraining opened, Registry& registry, RunListener* listener, const RunLoopOptions& options);
  RunLoop(const RunLoop&) = delete;
  RunLoop& operator=(const RunLoop&) = delete;

  Training& training() { return training_; }
  const Training& training() const { return training_; }
  const Session& session() const { return training_.session(); }
  const std::optional<RunFolder>& folder() const { return folder_; }
  /// The folder, or where a run without one was last saved; "" for neither.
  std::string run_dir() const { return folder_ ? folder_->path() : saved_in_; }

  /// Makes a round of self-training that is due, then at least one step and at most `most`: as many as run without
  /// waiting in between, up to the next row, round or the end. Then scores and saves what is due. Returns the losses of
  /// the steps, valid until the next call; none where the listener's stop signal ended the round, which stays due.
  /// Errors are those of Training::advance and of writing; where another rank is lost, steps that all have made are
  /// saved first.
  std::span<const StepLosses> advance(std::int64_t most);
  /// Training::train_more; run.yaml says so.
  void train_more(const AskedLength& asked);

  /// Writes rows that wait. Throws write_error; those not yet written still wait then.
  void write_rows();
  /// Writes classes.yaml where a name has changed. Throws write_error.
  void write_classes();
  /// Writes a checkpoint, after the rows before it, and returns its path. A run with a folder is saved there:
  /// `run_dir` is "" or that folder. A run without one is written to `run_dir`, which must be empty or one that it was
  /// written to before, and nothing of it stays locked: any program may continue it there. Throws Error(usage) for no
  /// folder or another one, Error(data) where somebody continued the folder, and write_error.
  std::string save(const std::string& run_dir = "");
  /// Whether no step was made since the newest checkpoint, or none at all.
  bool saved() const { return saved_step_ == training_.step(); }
  /// Whether report.checkpoint_every_s have passed since the last checkpoint, and steps were made.
  bool save_is_due() const;
  /// CheckpointStore::kept_text.
  std::string kept_text() const { return checkpoints_->kept_text(); }
  /// Of a loop with scores.
  RunScores& scores() { return *scores_; }
  RunScores::Moment moment() const { return {training_.step(), training_.train_s()}; }

 protected:
  RunListener& listener() { return listener_; }

 private:
  using Clock = std::chrono::steady_clock;

  std::span<const StepLosses> make_steps(std::int64_t most);
  bool make_round();
  void warn_of_slow_steps(double step_s);
  void record(const StepLosses& losses, std::int64_t step);
  void report_progress(const StepLosses& losses, const MetricsRow& row);
  void make_due();
  void write_records(const RunFolder& folder, const ResumePoint& point);
  std::string write_checkpoint(CheckpointStore& store, MetricsLog& log);
  std::string save_without_folder(const std::string& place);

  Registry& registry_;
  RunListener nobody_;
  RunListener& listener_;
  RunLoopOptions options_;
  std::optional<RunFolder> folder_;
  Training training_;
  WorkSettings work_;
  SelfTraining self_training_;
  std::optional<CheckpointStore> checkpoints_;
  std::optional<StepRows> step_rows_;
  std::deque<MetricsRow> waiting_;  // rows to write; without a folder all rows
  std::optional<MetricsLog> log_;
  std::optional<EventWriter> events_;
  std::optional<RunScores> scores_;
  std::string classes_written_;        // what classes.yaml holds
  std::string saved_in_, last_saved_;  // of a run without a folder
  std::int64_t saved_step_ = 0;        // of the newest checkpoint; 0 before the first step too
  double next_eval_s_ = 0;
  Clock::time_point last_save_ = Clock::now(), last_progress_ = Clock::now();
  bool warned_of_slow_steps_ = false;
};

}  // namespace semfield
