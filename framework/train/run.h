// A training run: opened, stepped, scored, saved, stopped, killed and resumed, by one loop for command line, Python and
// labelling page.
#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "config/settings/choices.h"
#include "config/settings/run_config.h"
#include "labels/clicks.h"
#include "train/checkpoint.h"
#include "train/metrics_log.h"
#include "train/opened_run.h"
#include "train/run_folder.h"
#include "train/run_scores.h"
#include "train/self_training.h"
#include "train/session.h"
#include "train/trainer.h"

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

/// Who gets a run's progress, and is asked between steps; every call comes from the thread that trains.
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
  /// Writes the report of a run that came to its end and returns its path (eval/report/report.h); "": there is none.
  virtual std::string write_report(const RunFolder&, const Session&, const ReportFrames&) { return ""; }
};

/// What drives a run decides what happens between its steps, in addition to the rows of metrics.jsonl.
enum class Driver : std::uint8_t {
  program,  ///< rounds of self-training; it saves on request
  command,  ///< the same, evaluations every report.eval_every_s, and checkpoints when due
  page,     ///< labels change with every click, so no rounds; rows wait for write_rows() and save(), so that a full
            ///< disk does not end training
};

struct TrainRequest {
  std::string out_dir = {};            ///< "": the run has no folder until save()
  bool resume = false;                 ///< continue in out_dir from its newest checkpoint that verifies
  std::vector<std::string> keep = {};  ///< components forced back in
  Ranks* ranks = nullptr;              ///< SessionOptions::ranks
  AskedLength more = {};               ///< with `resume`: what it trains from its checkpoint on; neither: to its end
  Driver driver = Driver::program;
  KeptScene* kept = nullptr;  ///< SessionOptions::kept
};

struct TrainOutcome {
  int signal = 0;  ///< the signal that ended the run early, after its checkpoint
  std::int64_t step = 0;
  double train_s = 0;    ///< seconds of training of the whole run
  double trained_s = 0;  ///< of them, those of this call
  std::string run_dir;
  std::string report_path;            ///< "" where the run was stopped or no report was requested
  ScoreValues values;                 ///< test split, final evaluation
  ScoredPart scored;                  ///< the frames that `values` are of
  std::vector<double> frame_psnr_db;  ///< of each of them, ascending
  std::size_t peak_bytes = 0;         ///< of the process
};

/// Steps have the same bits whoever drives, and every verb works on the folder. One thread at a time.
class Run {
 public:
  /// Opens the scene and, for a run that goes on, takes up its newest checkpoint; makes the folder of a new one when
  /// nothing can refuse it any more, and writes what the run is into it. Findings go to `opening` where it is given,
  /// else to `listener`. Either may be null. `listener` and `registry` must outlive the object; `opening` is used by
  /// the constructor alone. Throws Error, and then a new run has left nothing: as open_session and RunFolder do,
  /// Error(usage) for rounds of self-training without a folder, Error(config) naming every setting that would make it
  /// another run.
  Run(RunConfig config, Registry& registry, const TrainRequest& request, RunListener* listener,
      TrainingListener* opening = nullptr);

  ~Run();

  Trainer& training() { return *training_; }
  const Trainer& training() const { return *training_; }
  const Session& session() const { return session_; }
  const std::optional<RunFolder>& folder() const { return folder_; }
  /// The folder, or where a run without one was last saved; "" for neither.
  std::string run_dir() const { return folder_ ? folder_->path() : saved_in_; }
  /// What a resumed run came to that has nothing left to do; then nothing was written, and it makes no step.
  const std::optional<TrainOutcome>& ended() const { return ended_; }

  /// Makes a round of self-training that is due, then at least one step and at most `most`: as many as run without
  /// waiting in between, up to the next row, round or the end. Then scores and saves what is due. Returns the losses of
  /// the steps, valid until the next call; none where the listener's stop signal ended the round, which stays due.
  /// Errors are those of Trainer::advance and of writing; where another rank is lost, steps that all have made are
  /// saved first.
  std::span<const StepLosses> advance(std::int64_t most);
  /// Of Driver::command: steps to the end or to a stop signal, then the last scores and the report. Of a run that has
  /// ended, what it came to.
  TrainOutcome finish();
  /// Trainer::train_more; run.yaml says so.
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
  bool saved() const { return saved_step_ == training_->step(); }
  /// Whether report.checkpoint_every_s have passed since the last checkpoint, and steps were made.
  bool save_is_due() const;

  /// Clicks and classes; null where the configuration has neither scene.labels.clicks nor .class_room.
  const Annotations* annotations() const { return annotations_ ? &*annotations_ : nullptr; }
  /// The event is stored and synced, and counts from the next step on. False: an event of this id was there. Throws
  /// Error(usage) for a run without a file of clicks: the configuration names one, or has scene.labels.class_room and
  /// was opened with a folder; else as LabelSession::apply.
  bool apply(const LabelEvent& event);

 private:
  using Clock = std::chrono::steady_clock;

  ResumePoint open(RunConfig config, const TrainRequest& request, TrainingListener& told);
  bool make_round();
  std::int64_t steps_until_row(std::int64_t step) const;
  std::optional<MetricsRow> row_of(const StepLosses& losses, std::int64_t step);
  void record(const StepLosses& losses, std::int64_t step);
  void report_progress(const StepLosses& losses, const MetricsRow& row);
  void add_what_is_left(Error& error) const;
  void write_records(const RunFolder& folder);
  void write_label_counts(const RunFolder& folder) const;
  std::string write_checkpoint(CheckpointStore& store, MetricsLog& log);
  std::string save_without_folder(const std::string& place);

  Registry& registry_;
  RunListener nobody_;
  RunListener& listener_;
  Driver driver_;
  std::vector<std::string> changed_;  // "step 20: train.steps: 20 -> 40", settings that are others than before
  std::optional<RunFolder> folder_;   // locked
  std::optional<TrainOutcome> ended_;
  Session session_;
  WorkSettings work_;
  std::optional<Trainer> training_;
  std::optional<SelfTraining> self_training_;
  std::optional<CheckpointStore> checkpoints_;
  double row_mse_ = 0, row_start_s_ = 0;  // since the last row: sum over steps, and where it began
  std::int64_t row_steps_ = 0;
  std::deque<MetricsRow> waiting_;  // rows to write; without a folder all rows
  std::optional<MetricsLog> log_;
  std::unique_ptr<RunScores> scores_;
  std::optional<Annotations> annotations_;
  std::optional<ClickLog> clicks_;
  std::string classes_written_;        // what classes.yaml holds
  std::string saved_in_, last_saved_;  // of a run without a folder
  std::int64_t saved_step_ = 0;        // of the newest checkpoint; 0 before the first step too
  double next_eval_s_ = 0;
  Clock::time_point last_save_ = Clock::now(), last_progress_ = Clock::now();
  bool warned_of_slow_steps_ = false, memory_known_ = false;
};

}  // namespace semfield
