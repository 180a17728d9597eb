// Train a run in slices: steps, rows, rounds of self-training, scores and checkpoints in one loop that every driver
// uses.
#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "config/explain.h"
#include "labels/clicks/click_log.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "run/run_listener.h"
#include "run/run_scores.h"
#include "session/checkpoint_facts.h"
#include "session/self_training.h"
#include "session/session.h"
#include "session/settings/choices.h"
#include "session/settings/run_config.h"
#include "session/training.h"

namespace semfield {

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

/// None when a program of another version wrote them and they cannot be read.
std::optional<RunConfig> settings_of_checkpoint(const CheckpointFacts& facts, Registry& registry);

/// Warns of other inputs, labels and modules than the checkpoint's; Error(data) where classes have changed places.
void compare_with_training(const CheckpointFacts& facts, const SceneInputs& inputs, const Session& session,
                           Diagnostics& diagnostics);

/// For a run that is looked at by `config`, its run.yaml with `overrides`: throws Error(config) naming each setting of
/// the run's identity that run.yaml says otherwise than the checkpoint, and notes those that `overrides` say otherwise.
/// False where they name other frames, sizes or bounds than those of training: then other inputs are no news.
bool compare_settings_with_training(const CheckpointFacts& facts, const RunConfig& config, const RunFolder& folder,
                                    const std::vector<std::string>& overrides, Registry& registry,
                                    Diagnostics& diagnostics);

// A whole training run in its folder: steps, rows, evaluations, checkpoints; started, stopped, killed and
// resumed.

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

// How a run begins or goes on: its folder and session, and what it writes down before the first step.

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

// Drive a run step by step from a program: the loop of a run, with clicks, and a folder once it has one.

struct RunSessionOptions {
  std::string run_dir;            ///< made, or gone on with where `resume`; "": the run has no folder until save()
  bool resume = false;            ///< the configuration is run.yaml of run_dir, with overrides
  std::vector<std::string> keep;  ///< components forced back in
  AskedLength more = {};          ///< TrainRequest::more
};

/// Steps have the bits of `semfield train`, and every verb works on the folder. One thread at a time.
class RunSession : public RunLoop {
 public:
  /// Throws as open_session and RunFolder do, and Error(usage) for rounds of self-training without a folder.
  RunSession(RunConfig config, Registry& registry, const RunSessionOptions& options, RunListener& listener);

  /// Clicks and classes; null where the configuration has neither scene.labels.clicks nor .class_room.
  const Annotations* annotations() const { return annotations_ ? &*annotations_ : nullptr; }
  /// The event is stored and synced, and counts from the next step on. False: an event of this id was there. Throws
  /// Error(usage) for a run without a file of clicks: the configuration names one, or has scene.labels.class_room and
  /// was opened with a folder; else as LabelSession::apply.
  bool apply(const LabelEvent& event);

 private:
  std::optional<Annotations> annotations_;
  std::optional<ClickLog> clicks_;
};

}  // namespace semfield
