#include "run/run_loop.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <utility>

#include "execution/ranks/ranks.h"
#include "scene/classes/class_names.h"
#include "session/settings/run_identity.h"
#include "session/settings/run_length.h"
#include "system/files.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;

constexpr double kProgressEvery_s = 0.2;
// A process that is to end gets at least this before it is killed; drivers look at the signal after each step.
constexpr double kStopDeadline_s = 10;
constexpr std::size_t kMostWaiting = 100'000;  // rows of a run with a folder, while they cannot be written

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

std::string place_of(const std::string& folder) { return fs::weakly_canonical(fs::absolute(folder)).string(); }

}  // namespace

std::string ScoredPart::text() const {
  const std::string count =
      frames == of ? fmt::format("all {} frames", of) : fmt::format("{} of {} frames", frames, of);
  return stride == 1 ? count : fmt::format("{} at 1 pixel in {}", count, stride * stride);
}

double RunListener::now_s() { return std::chrono::duration<double>(Clock::now().time_since_epoch()).count(); }

RunLoop::RunLoop(OpenedForTraining opened, Registry& registry, RunListener* listener, const RunLoopOptions& options)
    : registry_(registry),
      listener_(listener != nullptr ? *listener : nobody_),
      options_(options),
      folder_(std::move(opened.folder)),
      training_(std::move(opened.session), &listener_, std::move(opened.inputs)),
      work_(session().work()),
      self_training_(session(), training_.rays(), folder_ ? folder_->self_labels_path() : "") {
  const WorkScope scope(work_);
  const ResumePoint& point = opened.point;
  if (folder_) {
    checkpoints_.emplace(folder_->checkpoints_path(), session().config.report.keep_checkpoints);
    if (options_.rounds) self_training_.resume(point.step(), point.facts ? point.facts->self_labels : "");
    write_records(*folder_, point);
    if (point.facts) training_.load(point.path);
    saved_step_ = training_.step();
    // Rows past the step taken up (all of them, for a run killed before its first checkpoint) are dropped.
    log_.emplace(MetricsLog::resume(folder_->metrics_path(), training_.step()));
  }
  step_rows_.emplace(session(), training_.train_s());
  if (!options_.scores) return;
  events_.emplace(folder_->path(), unix_seconds());
  scores_.emplace(session(), ScoreFiles{*folder_, *log_, *events_}, listener_, moment());
  const double every_s = session().config.report.eval_every_s;
  next_eval_s_ = every_s > 0 ? (std::floor(training_.train_s() / every_s) + 1) * every_s : INFINITY;
}

void RunLoop::write_records(const RunFolder& folder, const ResumePoint& point) {
  write_run_records(folder, training_, registry_, point);
  classes_written_ = named_classes(session().scene.info.classes).to_yaml();
  if (options_.rounds) write_label_counts(folder, session(), self_training_);
}

std::span<const StepLosses> RunLoop::advance(std::int64_t most) {
  const WorkScope scope(work_);
  try {
    if (!make_round()) return {};
    const std::span<const StepLosses> made = make_steps(most);
    make_due();
    return made;
  } catch (const RankLost&) {
    // On the CPU every step is made by all or not at all. A GPU may wait for ever for the rank that is gone.
    if (options_.saves && session().pipeline->executor().device().kind == Device::cpu && !saved()) save();
    throw;
  }
}

std::span<const StepLosses> RunLoop::make_steps(std::int64_t most) {
  const std::int64_t before = training_.step();
  const double before_s = training_.train_s();
  most = std::min(most, step_rows_->steps_until_row(before));
  if (const std::int64_t end = training_.last_step(); end > before) most = std::min(most, end - before);
  if (options_.rounds) most = self_training_.steps_until_due(before, most);
  const std::span<const StepLosses> made = training_.advance(most);
  if (training_.take_settled() && folder_) write_run_config(*folder_, session().config, registry_);
  warn_of_slow_steps((training_.train_s() - before_s) / static_cast<double>(made.size()));
  for (std::size_t i = 0; i < made.size(); ++i) record(made[i], before + 1 + static_cast<std::int64_t>(i));
  if (folder_ && !options_.rows_wait) write_rows();
  return made;
}

// What it takes is training. False: a stop was requested, and the round waits for whoever goes on.
bool RunLoop::make_round() {
  if (!options_.rounds || !self_training_.due(training_.step())) return true;
  const Clock::time_point start = Clock::now();
  const SelfTraining::Hooks hooks{[this](const ScoreProgress& p) { listener_.scoring(p); },
                                  [this] { return listener_.stop_signal() != 0; }};
  if (!self_training_.make_round(training_.step(), hooks)) return false;
  const double spent_s = seconds_since(start);
  training_.add_train_s(spent_s);
  step_rows_->leave_out(spent_s);
  listener_.note(self_training_.rounds().back().text());
  write_label_counts(*folder_, session(), self_training_);
  return true;
}

void RunLoop::warn_of_slow_steps(double step_s) {
  if (step_s <= kStopDeadline_s || warned_of_slow_steps_) return;
  warned_of_slow_steps_ = true;
  listener_.note(
      fmt::format("a step takes {:.0f} s: SIGINT and SIGTERM are answered after it, later than the {:.0f} s "
                  "promised; fewer train.rays make steps shorter",
                  step_s, kStopDeadline_s));
}

void RunLoop::record(const StepLosses& losses, std::int64_t step) {
  std::optional<MetricsRow> row = step_rows_->add(losses, step, training_.train_s());
  if (!row) return;
  listener_.row(*row);
  if (events_)
    for (const auto& [name, value] : row->values)
      if (value) events_->scalar("train/" + name, step, *value, unix_seconds());
  report_progress(losses, *row);
  if (!folder_ || waiting_.size() < kMostWaiting) waiting_.push_back(*std::move(row));
}

void RunLoop::report_progress(const StepLosses& losses, const MetricsRow& row) {
  if (seconds_since(last_progress_) < kProgressEvery_s && !training_.at_its_end()) return;
  last_progress_ = Clock::now();
  const RunConfig& config = session().config;
  TrainProgress p;
  p.step = training_.step();
  p.steps = training_.last_step();
  p.loss = losses.total;
  for (std::size_t i = 0; i < config.losses.size(); ++i)
    if ((losses.active >> i & 1U) != 0) p.terms.emplace_back(config.losses[i].type, losses.terms[i]);
  p.psnr = *row.get("psnr");
  p.rays_per_s = *row.get("rays_per_s");
  if (scores_) {
    p.miou_present = scores_->last_miou_present();
    p.scored = scores_->last_part();
  }
  p.train_s = training_.train_s();
  const double per_step = p.train_s / static_cast<double>(std::max<std::int64_t>(p.step, 1));
  p.remaining_s = p.steps > 0 ? per_step * static_cast<double>(p.steps - p.step) : end_s(config) - p.train_s;
  listener_.progress(p);
}

void RunLoop::make_due() {
  if (scores_ && training_.train_s() >= next_eval_s_) {
    next_eval_s_ += session().config.report.eval_every_s;
    scores_->score_sample(moment());
  }
  if (!options_.saves) return;
  if (save_is_due()) save();
  if (listener_.save_request()) {
    save();
    listener_.note(fmt::format("checkpoint of step {} saved as asked", saved_step_));
  }
}

void RunLoop::train_more(const AskedLength& asked) {
  training_.train_more(asked);
  if (folder_) write_run_config(*folder_, session().config, registry_);
}

void RunLoop::write_rows() {
  for (; !waiting_.empty(); waiting_.pop_front()) log_->append(waiting_.front());
}

void RunLoop::write_classes() {
  const std::string classes = named_classes(session().scene.info.classes).to_yaml();
  if (!folder_ || classes == classes_written_) return;
  write_file_atomic(folder_->classes_path(), classes);
  classes_written_ = classes;
}

bool RunLoop::save_is_due() const {
  const double every_s = session().config.report.checkpoint_every_s;
  return every_s > 0 && !saved() && seconds_since(last_save_) >= every_s;
}

std::string RunLoop::write_checkpoint(CheckpointStore& store, MetricsLog& log) {
  const std::vector<TensorRef> tensors = training_.state();
  log.sync();  // a checkpoint that outlives a power cut has its rows
  CheckpointFacts facts = training_.facts();
  facts.self_labels = self_training_.named();
  std::string path = store.save(facts.step, tensors, checkpoint_metadata(facts, identity_hash(session().config)));
  saved_step_ = training_.step();
  last_save_ = Clock::now();
  return path;
}

std::string RunLoop::save(const std::string& run_dir) {
  const WorkScope scope(work_);
  const std::string own = folder_ ? place_of(folder_->path()) : saved_in_;
  if (own.empty() && run_dir.empty())
    throw Error(ErrorKind::usage, "run.folder.unnamed", "the run has no folder yet", "name the folder to save it in");
  const std::string place = run_dir.empty() ? own : place_of(run_dir);
  if (!folder_) return save_without_folder(place);
  if (place != own)
    throw Error(ErrorKind::usage, "run.folder.own",
                "the run has the folder '" + own + "' and cannot be saved in '" + run_dir + "'",
                "save it in its own folder; a copy of the folder is a run too");
  write_rows();
  return write_checkpoint(*checkpoints_, *log_);
}

std::string RunLoop::save_without_folder(const std::string& place) {
  const bool again = place == saved_in_;
  (void)run_config_text(session().config, registry_);  // what cannot be stored leaves no folder
  training_.state();
  const RunFolder folder = again ? RunFolder::resume(place) : RunFolder::create(place);
  if (again) {
    const std::vector<CheckpointStore::Entry> there = CheckpointStore::read(folder.checkpoints_path()).list();
    if (!there.empty() && there.front().path != last_saved_)
      throw Error(ErrorKind::data, "run.folder.ahead",
                  "somebody continued the run in '" + place + "': its newest checkpoint is " + there.front().path,
                  "save this one in another folder");
  }
  write_run_config(folder, session().config, registry_);
  if (!again) write_records(folder, {});
  MetricsLog log = MetricsLog::resume(folder.metrics_path(), 0);
  for (const MetricsRow& row : waiting_) log.append(row);
  CheckpointStore store(folder.checkpoints_path(), session().config.report.keep_checkpoints);
  last_saved_ = write_checkpoint(store, log);
  saved_in_ = place;
  return last_saved_;
}

}  // namespace semfield
