#include "run/train_run.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <filesystem>

#include "compute/parallel.h"
#include "config/compose.h"
#include "core/findings.h"
#include "core/text.h"
#include "eval/final_eval.h"
#include "run/checkpoint_store.h"
#include "run/rows/step_rows.h"
#include "run/run_folder.h"
#include "run/run_start.h"
#include "session/self_training.h"
#include "session/trainer.h"
#include "settings/run_identity.h"
#include "system/files.h"
#include "system/memory_limit.h"

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

constexpr double kProgressEvery_s = 0.2;
// A process that is asked to end gets at least this before it is killed; the loop looks at the signal after each step.
constexpr double kStopDeadline_s = 10;

// As long again as it trained.
std::string train_on_words(const std::string& run_dir, double train_s) {
  return fmt::format("semfield train --resume {} --time {:.0f}s", shell_word(run_dir), std::ceil(train_s));
}

// The run's moving parts while it trains.
class Run {
 public:
  Run(RunFolder folder, Session opened, Registry& registry, RunListener& listener, ResumePoint point,
      SceneInputs inputs)
      : registry_(registry),
        listener_(listener),
        folder_(std::move(folder)),
        training_(std::move(opened), &listener, std::move(inputs)),
        checkpoints_(folder_.checkpoints_path(), session().config.report.keep_checkpoints),
        point_(std::move(point)),
        self_training_(session(), training_.rays(), folder_.self_labels_path()) {
    const WorkScope scope(work_);
    write_run_records(folder_, training_, registry, point_);
    write_labels();
  }

  /// Takes up the checkpoint of the resume point; without one the run starts at step 0.
  void go_on() {
    const WorkScope scope(work_);
    for (const ConfigDifference& change : point_.changed)
      note(fmt::format("from step {} on: {}", point_.step(), change.text()));
    self_training_.resume(point_.step(), point_.facts ? point_.facts->self_labels : std::string());
    write_labels();
    if (!point_.facts) {
      note("no checkpoint yet: starting from step 0");
      return;
    }
    training_.load(point_.path);
    rows_.leave_out(training_.train_s());
    note(fmt::format("resuming at step {} ({:.1f} s of training) from {}", point_.step(), training_.train_s(),
                     point_.path));
    // Its last evaluation may have been cut off, and settings of the page may be others now.
    if (training_.at_its_end())
      note(fmt::format("the run has come to its end, {} steps: it is scored again, not trained; to train on: {}",
                       training_.step(), train_on_words(folder_.path(), training_.train_s())));
  }

  /// A write that fails ends the run; the message then tells what is left of it.
  TrainOutcome train() {
    const WorkScope scope(work_);
    try {
      return train_to_the_end();
    } catch (RankLost& lost) {
      lost.while_doing(
          fmt::format("training ended at step {} ({}; resume with `semfield train --resume {}`, with any "
                      "number of processes)",
                      training_.step(), checkpoints_.kept_text(), shell_word(folder_.path())));
      throw;
    } catch (Error& error) {
      const bool writing = error.kind() == ErrorKind::io || error.kind() == ErrorKind::cannot_create;
      if (writing && error.message().starts_with("cannot ")) {
        const std::string kept = error.context().empty() ? checkpoints_.kept_text() + "; " : "";  // a save has said it
        error.while_doing(fmt::format("training ended at step {} ({}resume with `semfield train --resume {}`)",
                                      training_.step(), kept, shell_word(folder_.path())));
      }
      throw;
    }
  }

 private:
  TrainOutcome train_to_the_end() {
    // Rows past the step taken up (all of them, for a run killed before its first checkpoint) are dropped.
    MetricsLog log = MetricsLog::resume(folder_.metrics_path(), training_.step());
    EventWriter events(folder_.path(), unix_seconds());
    log_ = &log;
    events_ = &events;
    scores_.emplace(session(), ScoreFiles{folder_, log, events}, listener_, moment());
    const RunConfig& config = session().config;
    last_checkpoint_ = last_progress_ = Clock::now();
    const double start_s = training_.train_s();
    next_eval_s_ = config.report.eval_every_s > 0
                       ? (std::floor(training_.train_s() / config.report.eval_every_s) + 1) * config.report.eval_every_s
                       : INFINITY;
    saved_step_ = training_.step();
    listener_.stop_waits(true);
    try {
      make_steps();
    } catch (const RankLost&) {
      // On the processor every step is made by all or not at all. A device may wait for ever for the one that is gone.
      if (session().pipeline->executor().device().kind == Device::cpu && training_.step() != saved_step_) save();
      throw;
    }
    if (training_.step() != saved_step_ || training_.step() == 0) save();
    listener_.stop_waits(false);
    const int signal = listener_.stop_signal();
    TrainOutcome outcome;
    if (signal == 0) {
      outcome.values = scores_->score_end(moment());
      outcome.scored = scores_->last_part();
    }
    outcome.signal = signal;
    outcome.step = training_.step();
    outcome.train_s = training_.train_s();
    outcome.trained_s = training_.train_s() - start_s;
    outcome.run_dir = folder_.path();
    outcome.peak_bytes = peak_resident_bytes();
    if (signal == 0) outcome.report_path = listener_.write_report(folder_, session(), scores_->report_frames());
    return outcome;
  }

  // Until the last step or a stop.
  void make_steps() {
    const RunConfig& config = session().config;
    while (!training_.at_its_end()) {
      if (self_training_.due(training_.step()) && !make_round()) break;
      const double before_s = training_.train_s();
      const std::span<const StepLosses> steps = training_.advance(steps_until_row());
      if (training_.take_settled()) write_run_config(folder_, config, registry_);
      const double step_s = (training_.train_s() - before_s) / static_cast<double>(steps.size());
      if (step_s > kStopDeadline_s && !warned_of_slow_steps_) {
        warned_of_slow_steps_ = true;
        note(
            fmt::format("a step takes {:.0f} s: SIGINT and SIGTERM are answered after it, later than the {:.0f} s "
                        "promised; fewer train.rays make steps shorter",
                        step_s, kStopDeadline_s));
      }
      for (std::size_t i = 0; i < steps.size(); ++i) {
        record(steps[i], training_.step() - std::ssize(steps) + 1 + static_cast<std::int64_t>(i));
      }
      if (training_.train_s() >= next_eval_s_) {
        next_eval_s_ += config.report.eval_every_s;
        scores_->score_sample(moment());
      }
      if (config.report.checkpoint_every_s > 0 && seconds_since(last_checkpoint_) >= config.report.checkpoint_every_s)
        save();
      if (listener_.save_request()) {
        save();
        note(fmt::format("checkpoint of step {} saved as asked", saved_step_));
      }
      if (listener_.stop_signal() != 0) break;
    }
  }

  RunScores::Moment moment() const { return {training_.step(), training_.train_s()}; }

  const Session& session() const { return training_.session(); }
  void note(const std::string& text) const { listener_.note(text); }

  // Steps to the next row of the log, the next round of self-training, or the end.
  std::int64_t steps_until_row() const {
    const std::int64_t step = training_.step();
    std::int64_t most = rows_.steps_until_row(step);
    if (const std::int64_t end = training_.last_step(); end > 0) most = std::min(most, end - step);
    return self_training_.steps_until_due(step, most);
  }

  // What it takes is training. False: a stop was asked for, and the round waits for the resume.
  bool make_round() {
    const Clock::time_point start = Clock::now();
    const SelfTraining::Hooks hooks{[this](const ScoreProgress& p) { listener_.scoring(p); },
                                    [this] { return listener_.stop_signal() != 0; }};
    if (!self_training_.make_round(training_.step(), hooks)) return false;
    const double spent_s = seconds_since(start);
    training_.add_train_s(spent_s);
    rows_.leave_out(spent_s);
    note(self_training_.rounds().back().text());
    write_labels();
    return true;
  }

  void write_labels() const { write_label_counts(folder_, session(), self_training_); }

  void save() {
    const std::vector<TensorRef> tensors = training_.state();
    if (log_ != nullptr) log_->sync();  // a checkpoint that outlives a power cut has its rows
    CheckpointFacts facts = training_.facts();
    facts.self_labels = self_training_.named();
    checkpoints_.save(facts.step, tensors, checkpoint_metadata(facts, identity_hash(session().config)));
    saved_step_ = training_.step();
    last_checkpoint_ = Clock::now();
  }

  void record(const StepLosses& losses, std::int64_t step) {
    const std::optional<MetricsRow> row = rows_.add(losses, step, training_.train_s());
    if (!row) return;
    log_->append(*row);
    for (const auto& [name, value] : row->values)
      if (value) events_->scalar("train/" + name, step, *value, unix_seconds());
    report_progress(losses, *row->get("psnr"), *row->get("rays_per_s"));
  }

  void report_progress(const StepLosses& losses, double psnr, double rays_per_s) {
    if (seconds_since(last_progress_) < kProgressEvery_s && !training_.at_its_end()) return;
    last_progress_ = Clock::now();
    const RunConfig& config = session().config;
    TrainProgress p;
    p.step = training_.step();
    p.steps = training_.last_step();
    p.loss = losses.total;
    for (std::size_t i = 0; i < config.losses.size(); ++i)
      if ((losses.active >> i & 1U) != 0) p.terms.emplace_back(config.losses[i].type, losses.terms[i]);
    p.psnr = psnr;
    p.miou_present = scores_->last_miou_present();
    p.scored = scores_->last_part();
    p.rays_per_s = rays_per_s;
    p.train_s = training_.train_s();
    const double per_step = training_.train_s() / static_cast<double>(std::max<std::int64_t>(p.step, 1));
    p.remaining_s =
        p.steps > 0 ? per_step * static_cast<double>(p.steps - p.step) : end_s(config) - training_.train_s();
    listener_.progress(p);
  }

  Registry& registry_;
  RunListener& listener_;
  RunFolder folder_;
  Training training_;
  WorkSettings work_ = session().work();
  CheckpointStore checkpoints_;
  ResumePoint point_;
  SelfTraining self_training_;
  StepRows rows_{session(), 0};
  MetricsLog* log_ = nullptr;
  EventWriter* events_ = nullptr;
  double next_eval_s_ = 0;
  std::int64_t saved_step_ = 0;
  Clock::time_point last_checkpoint_, last_progress_;
  bool warned_of_slow_steps_ = false;
  std::optional<RunScores> scores_;
};

}  // namespace

TrainOutcome run_training(RunConfig config, Registry& registry, const TrainRequest& request, RunListener* told) {
  RunListener nobody;
  RunListener& listener = told != nullptr ? *told : nobody;
  OpenedForTraining opened = open_for_training(std::move(config), registry, request, listener);
  if (opened.ended) {
    listener.note(fmt::format("the run has come to its end, {} steps, and nothing of it was changed; to train on: {}",
                              opened.ended->step, train_on_words(opened.ended->run_dir, opened.ended->train_s)));
    return *opened.ended;
  }
  Run run(std::move(*opened.folder), std::move(opened.session), registry, listener, std::move(opened.point),
          std::move(opened.inputs));
  if (request.resume) run.go_on();
  return run.train();
}

}  // namespace semfield
