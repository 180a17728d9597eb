#include "train/run.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <filesystem>
#include <limits>

#include "compute/parallel.h"
#include "config/explain.h"
#include "core/check.h"
#include "core/error.h"
#include "core/files.h"
#include "core/process.h"
#include "core/text.h"
#include "eval/final_eval.h"
#include "execution/ranks/ranks.h"
#include "labels/training_labels.h"
#include "plugin/loader.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

constexpr double kProgressEvery_s = 0.2;
// A process that is to end gets at least this before it is killed; drivers look at the signal after each step.
constexpr double kStopDeadline_s = 10;
constexpr std::size_t kMostWaiting = 100'000;  // rows of a run with a folder, while they cannot be written
constexpr const char* kLength = "length";      // among the settings that a resume changes
constexpr std::int64_t kAllSteps = std::numeric_limits<std::int64_t>::max();

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

std::string place_of(const std::string& folder) { return fs::weakly_canonical(fs::absolute(folder)).string(); }

// run.yaml, as the session's configuration is now; nothing is written where the file says so already.
void write_run_config(const RunFolder& folder, const RunConfig& config, Registry& registry) {
  const std::string text = run_config_text(config, registry);
  if (is_there(folder.config_path()) && read_text_file(folder.config_path()) == text) return;
  write_file_atomic(folder.config_path(), text);
}

// As long again as it trained.
std::string train_on_words(const std::string& run_dir, double train_s) {
  return fmt::format("semfield train --resume {} --time {:.0f}s", shell_word(run_dir), std::ceil(train_s));
}

// What the process holds when the first steps are made. Throws Error(unavailable) where it is more than
// runtime.memory_gb.
std::size_t memory_of_first_steps(const RunConfig& config) {
  const std::size_t bytes = resident_bytes();
  const double most_gb = config.runtime.memory_gb;
  if (most_gb > 0 && static_cast<double>(bytes) > most_gb * (1 << 30))
    throw Error(
        ErrorKind::unavailable, "memory.training.size",
        fmt::format("after its first steps the process holds {} of memory, and runtime.memory_gb allows {:g} GB",
                    memory_text(bytes), most_gb),
        "lower train.rays or runtime.lanes, make the encoder smaller, or raise scene.load.downscale, and train "
        "into another folder");
  return bytes;
}

}  // namespace

double RunListener::now_s() { return std::chrono::duration<double>(Clock::now().time_since_epoch()).count(); }

Run::Run(RunConfig config, Registry& registry, const TrainRequest& request, RunListener* listener,
         TrainingListener* opening)
    : registry_(registry), listener_(listener != nullptr ? *listener : nobody_), driver_(request.driver) {
  const ResumePoint point = open(std::move(config), request, opening != nullptr ? *opening : listener_);
  if (ended_) {
    listener_.note(
        fmt::format("the run has ended at step {}; nothing of it was changed; to train on: `{}`",
                    ended_->step, train_on_words(run_dir(), ended_->train_s)));
    return;
  }
  const WorkScope scope(work_);
  for (const ConfigDifference& change : point.changed)
    changed_.push_back(fmt::format("step {}: {}", point.step(), change.text()));
  if (folder_) {
    checkpoints_.emplace(folder_->checkpoints_path(), session_.config.report.keep_checkpoints);
    if (driver_ != Driver::page) self_training_->resume(point.step(), point.facts ? point.facts->self_labels : "");
    write_records(*folder_);
    if (point.facts) training_->load(point.path);
    saved_step_ = training_->step();
    // Rows past the step taken up (all of them, for a run killed before its first checkpoint) are dropped.
    log_.emplace(MetricsLog::resume(folder_->metrics_path(), training_->step()));
  }
  row_start_s_ = training_->train_s();
  if (driver_ != Driver::command) return;
  scores_ = std::make_unique<RunScores>(*training_, *folder_, *log_, listener_);
  const double every_s = session_.config.report.eval_every_s;
  next_eval_s_ = every_s > 0 ? (std::floor(training_->train_s() / every_s) + 1) * every_s : INFINITY;
  if (!request.resume) return;
  for (const ConfigDifference& change : point.changed)
    listener_.note(change.key == kLength
                       ? fmt::format("training continues from step {}, up to {} in all", point.step(), change.right)
                       : fmt::format("from step {} on: {}", point.step(), change.text()));
  if (!point.facts) {
    listener_.note("no checkpoint yet: starting from step 0");
    return;
  }
  listener_.note(fmt::format("resuming at step {} ({:.1f} s of training) from {}", training_->step(),
                             training_->train_s(), point.path));
  // Its last evaluation may have been cut off, and settings of the page may be others now.
  if (training_->at_its_end())
    listener_.note(
        fmt::format("the run has ended at step {}: it is scored again, not trained; to train on: `{}`",
                    training_->step(), train_on_words(run_dir(), training_->train_s())));
}

// Scene, network and folder. A new run's folder is made when nothing can refuse the run any more; a resumed one is
// locked first.
ResumePoint Run::open(RunConfig config, const TrainRequest& request, TrainingListener& told) {
  const std::string& out_dir = request.out_dir;
  if (out_dir.empty() && !config.self_training.at.empty())
    throw Error(ErrorKind::usage, "run.folder.unnamed",
                "train.self_training: its rounds are written to the run's folder, and this run has none",
                "name a folder when the run is opened");
  // A program's run that has room for classes and a folder keeps its clicks there.
  LabelParams& labels = config.labels.selection;
  if (driver_ == Driver::program && labels.clicks.empty() && labels.class_room > 0 && !out_dir.empty())
    labels.clicks = (fs::absolute(out_dir) / kClickFile).string();
  Diagnostics diagnostics;
  SessionOptions options;
  options.keep = request.keep;
  options.probe = true;
  options.ranks = request.ranks;
  options.kept = request.kept;
  if (config.report.training_frames > 0) options.depth = DepthKept::all;
  if (!out_dir.empty()) settle_click_file(config.labels, out_dir);
  if (!request.resume && !out_dir.empty()) RunFolder::require_new(out_dir);
  ResumePoint point;
  if (request.resume) {
    folder_.emplace(RunFolder::resume(out_dir));
    keep_components(config, request.keep);
    point = find_resume_point(*folder_, config, registry_, diagnostics);
    if (request.more.any()) {
      const std::string before = length_text(config);
      ask_more(config, request.more, point.step(), point.facts ? point.facts->train_s : 0);
      point.changed.push_back({kLength, before, length_text(config)});
    }
    require_scene_places(config, folder_->path());
    require_clicks({point.facts.has_value(), point.facts ? point.facts->clicks : std::nullopt}, config.labels,
                   folder_->path(), diagnostics);
    if (point.facts) options.trained_classes = point.facts->classes;
  }
  const std::size_t before = diagnostics.all().size();
  session_ = open_session(std::move(config), registry_, options, diagnostics);
  work_ = session_.work();
  std::string findings;
  for (std::size_t i = before; i < diagnostics.all().size(); ++i) findings += diagnostics.all()[i].text() + "\n";
  SceneInputs inputs = scene_inputs(session_.scene, session_.labels);
  if (point.facts) compare_with_training(*point.facts, inputs, session_, diagnostics);
  told.opened(diagnostics, session_);
  if (folder_ && driver_ == Driver::command) ended_ = ended_run(*folder_, session_.config, point);
  if (!out_dir.empty() && !folder_) {
    (void)run_config_text(session_.config, registry_);  // what cannot be stored leaves no folder
    folder_.emplace(RunFolder::create(out_dir));
  }
  if (folder_ && !ended_) {
    write_run_config(*folder_, session_.config, registry_);
    if (!findings.empty() || fs::exists(folder_->findings_path()))
      write_file_atomic(folder_->findings_path(), findings);
  }
  training_.emplace(session_, &listener_, nullptr, std::move(inputs));
  self_training_.emplace(session_, training_->rays(), folder_ ? folder_->self_labels_path() : "");
  annotations_ = session_.config.labels.clicks;
  return point;
}

Run::~Run() = default;

void Run::write_records(const RunFolder& folder) {
  classes_written_ = named_classes(session_.scene.info.classes).to_yaml();
  if (!session_.scene.info.classes.empty()) write_file_atomic(folder.classes_path(), classes_written_);
  write_file_atomic(folder.left_out_path(), left_out_json(session_.plan.left_out));
  Environment environment = this_environment();
  environment.threads = thread_count();
  environment.seed = session_.config.runtime.seed;
  environment.input_hash = training_->inputs().hash();
  // The file that is about to be written again holds the run's start, and the changes of earlier resumes.
  const std::string path = folder.environment_path();
  std::string started = fmt::format("{:%Y-%m-%d %H:%M} UTC", fmt::gmtime(std::time(nullptr)));
  if (fs::exists(path)) {
    const std::string before = read_text_file(path);
    environment.settings_changed = parse_settings_changed(before, path);
    for (const auto& [name, value] : parse_environment(before, path))
      if (name == "started") started = value;
  }
  for (const std::string& line : changed_) {
    std::vector<std::string>& all = environment.settings_changed;
    if (std::find(all.begin(), all.end(), line) == all.end()) all.push_back(line);
  }
  for (const PluginEntry* entry : registry_.entries()) environment.modules.push_back(entry->module);
  const Executor<float>& executor = session_.pipeline->executor();
  environment.more = {
      {"started", started},
      {"device", executor.description()},
      {"matrix products", executor.matrix_products()},
      {"precision", std::string(precision_name(session_.config.runtime.precision))},
  };
  write_file_atomic(path, environment_json(environment));
  if (driver_ != Driver::page) write_label_counts(folder);
}

void Run::write_label_counts(const RunFolder& folder) const {
  write_file_atomic(folder.labels_path(), label_counts_json(session_.manifest, session_.scene.info.classes,
                                                            session_.labels.steps, self_training_->rounds()));
}

std::span<const StepLosses> Run::advance(std::int64_t most) {
  const WorkScope scope(work_);
  try {
    const std::int64_t before = training_->step();
    if (driver_ != Driver::page && self_training_->due(before)) {
      if (!make_round()) return {};
    }
    const double before_s = training_->train_s();
    most = std::min(most, steps_until_row(before));
    if (const std::int64_t end = training_->last_step(); end > before) most = std::min(most, end - before);
    if (driver_ != Driver::page) most = self_training_->steps_until_due(before, most);
    const std::span<const StepLosses> made = training_->advance(most);
    if (training_->take_settled() && folder_) write_run_config(*folder_, session_.config, registry_);
    const double step_s = (training_->train_s() - before_s) / static_cast<double>(made.size());
    if (step_s > kStopDeadline_s && !std::exchange(warned_of_slow_steps_, true))
      listener_.note(
          fmt::format("a step takes {:.0f} s: SIGINT and SIGTERM are answered after it, later than the {:.0f} s "
                      "promised; fewer train.rays make steps shorter",
                      step_s, kStopDeadline_s));
    for (std::size_t i = 0; i < made.size(); ++i) record(made[i], before + 1 + static_cast<std::int64_t>(i));
    if (folder_ && driver_ != Driver::page) write_rows();
    if (!memory_known_) {
      const std::size_t bytes = memory_of_first_steps(session_.config);
      memory_known_ = true;
      if (driver_ == Driver::command)
        listener_.note(fmt::format("after the first steps the process holds {} of memory", memory_text(bytes)));
    }
    if (scores_ && training_->train_s() >= next_eval_s_) {
      next_eval_s_ += session_.config.report.eval_every_s;
      scores_->score_sample();
    }
    if (driver_ != Driver::command) return made;
    if (save_is_due()) save();
    if (listener_.save_request()) {
      save();
      listener_.note(fmt::format("checkpoint of step {} saved as asked", saved_step_));
    }
    return made;
  } catch (const RankLost&) {
    // On the CPU every step is made by all or not at all. A GPU may wait for ever for the rank that is gone.
    if (driver_ == Driver::command && session_.pipeline->executor().device().kind == Device::cpu && !saved()) save();
    throw;
  }
}

// What it takes is training. False: a stop was requested, and the round waits for whoever goes on.
bool Run::make_round() {
  const Clock::time_point start = Clock::now();
  const SelfTraining::Hooks hooks{[this](const ScoreProgress& p) { listener_.scoring(p); },
                                  [this] { return listener_.stop_signal() != 0; }};
  if (!self_training_->make_round(training_->step(), hooks)) return false;
  const double spent_s = seconds_since(start);
  training_->add_train_s(spent_s);
  row_start_s_ += spent_s;  // no steps, which rays_per_s is of
  listener_.note(self_training_->rounds().back().text());
  write_label_counts(*folder_);
  return true;
}

void Run::record(const StepLosses& losses, std::int64_t step) {
  std::optional<MetricsRow> row = row_of(losses, step);
  if (!row) return;
  listener_.row(*row);
  report_progress(losses, *row);
  if (!folder_ || waiting_.size() < kMostWaiting) waiting_.push_back(*std::move(row));
}

// Steps from `step` to the next row.
std::int64_t Run::steps_until_row(std::int64_t step) const {
  const std::int64_t every = session_.config.report.log_every_steps;
  return every - step % every;
}

// The row of metrics.jsonl that a step completes, if it does, with means since the row before.
std::optional<MetricsRow> Run::row_of(const StepLosses& losses, std::int64_t step) {
  const RunConfig& config = session_.config;
  row_mse_ += losses.mse;
  ++row_steps_;
  if (step % config.report.log_every_steps != 0 && step != last_step(config)) return std::nullopt;
  const double train_s = training_->train_s(), span = std::max(train_s - row_start_s_, 1e-9);
  MetricsRow row;
  row.step = step;
  row.train_s = train_s;
  row.set("loss", losses.total);
  row.set("loss_color", losses.color);
  if (session_.pipeline->has_semantics()) row.set("loss_semantic", losses.semantic);
  const std::vector<LossEntry>& terms = config.losses;
  for (std::size_t i = 0; i < terms.size(); ++i) {  // without a value while the term has not begun
    row.set("loss_" + terms[i].type, (losses.active >> i & 1U) != 0 ? std::optional(losses.terms[i]) : std::nullopt);
  }
  row.set("psnr", -10 * std::log10(row_mse_ / static_cast<double>(row_steps_)));
  row.set("rays_per_s", static_cast<double>(row_steps_ * config.train.rays) / span);
  row.set("samples_per_ray", static_cast<double>(losses.samples) / static_cast<double>(config.train.rays));
  row_mse_ = 0;
  row_steps_ = 0;
  row_start_s_ = train_s;
  return row;
}

void Run::report_progress(const StepLosses& losses, const MetricsRow& row) {
  if (seconds_since(last_progress_) < kProgressEvery_s && !training_->at_its_end()) return;
  last_progress_ = Clock::now();
  const RunConfig& config = session_.config;
  TrainProgress p;
  p.step = training_->step();
  p.steps = training_->last_step();
  p.loss = losses.total;
  for (std::size_t i = 0; i < config.losses.size(); ++i)
    if ((losses.active >> i & 1U) != 0) p.terms.emplace_back(config.losses[i].type, losses.terms[i]);
  p.psnr = *row.get("psnr");
  p.rays_per_s = *row.get("rays_per_s");
  if (scores_) {
    p.miou_present = scores_->last_miou_present;
    p.scored = scores_->last_part;
  }
  p.train_s = training_->train_s();
  const double per_step = p.train_s / static_cast<double>(std::max<std::int64_t>(p.step, 1));
  p.remaining_s = p.steps > 0 ? per_step * static_cast<double>(p.steps - p.step) : end_s(config) - p.train_s;
  listener_.progress(p);
}

void Run::train_more(const AskedLength& asked) {
  training_->train_more(asked);
  if (folder_) write_run_config(*folder_, session_.config, registry_);
}

void Run::write_rows() {
  for (; !waiting_.empty(); waiting_.pop_front()) log_->append(waiting_.front());
}

void Run::write_classes() {
  const std::string classes = named_classes(session_.scene.info.classes).to_yaml();
  if (!folder_ || classes == classes_written_) return;
  write_file_atomic(folder_->classes_path(), classes);
  classes_written_ = classes;
}

bool Run::save_is_due() const {
  const double every_s = session_.config.report.checkpoint_every_s;
  return every_s > 0 && !saved() && seconds_since(last_save_) >= every_s;
}

std::string Run::write_checkpoint(CheckpointStore& store, MetricsLog& log) {
  const std::vector<TensorRef> tensors = training_->state();
  log.sync();  // a checkpoint that outlives a power cut has its rows
  CheckpointFacts facts = training_->facts();
  facts.self_labels = self_training_->named();
  std::string path = store.save(facts.step, tensors, checkpoint_metadata(facts, identity_hash(session_.config)));
  saved_step_ = training_->step();
  last_save_ = Clock::now();
  return path;
}

std::string Run::save(const std::string& run_dir) {
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

std::string Run::save_without_folder(const std::string& place) {
  const bool again = place == saved_in_;
  (void)run_config_text(session_.config, registry_);  // what cannot be stored leaves no folder
  training_->state();
  const RunFolder folder = again ? RunFolder::resume(place) : RunFolder::create(place);
  if (again) {
    const std::vector<CheckpointStore::Entry> there = CheckpointStore::read(folder.checkpoints_path()).list();
    if (!there.empty() && there.front().path != last_saved_)
      throw Error(ErrorKind::data, "run.folder.ahead",
                  "somebody continued the run in '" + place + "': its newest checkpoint is " + there.front().path,
                  "save this one in another folder");
  }
  write_run_config(folder, session_.config, registry_);
  if (!again) write_records(folder);
  MetricsLog log = MetricsLog::resume(folder.metrics_path(), 0);
  for (const MetricsRow& row : waiting_) log.append(row);
  CheckpointStore store(folder.checkpoints_path(), session_.config.report.keep_checkpoints);
  last_saved_ = write_checkpoint(store, log);
  saved_in_ = place;
  return last_saved_;
}

bool Run::apply(const LabelEvent& event) {
  const LabelConfig& labels = session_.config.labels;
  if (!annotations_ || labels.selection.clicks.empty())
    throw Error(ErrorKind::usage, "labels.clicks.missing", "the run has no file of clicks",
                "open it with a folder and scene.labels.class_room, or with scene.labels.clicks");
  if (!clicks_) {  // not before somebody clicks: to learn from another run's clicks is no reason to hold their file
    Diagnostics ignored;  // stated when the scene was opened by the file
    clicks_.emplace(open_click_log(labels, run_dir(), ignored));
  }
  Annotations next = *annotations_;
  if (!next.apply(event)) return false;
  std::vector<int> frames = annotations_->frames_with_marks();
  for (const int frame : next.frames_with_marks())
    if (std::find(frames.begin(), frames.end(), frame) == frames.end()) frames.push_back(frame);
  training_->set_clicks(next, frames);
  try {
    clicks_->append(event);
  } catch (...) {
    training_->set_clicks(*annotations_, frames);
    throw;
  }
  annotations_ = std::move(next);
  try {
    write_classes();
  } catch (const Error& error) {  // the event is stored already: a later one writes the file
    listener_.warning("classes.yaml is behind the classes: " + shown(error));
  }
  return true;
}

TrainOutcome Run::finish() {
  if (ended_) return *ended_;
  SEMFIELD_CHECK(scores_ != nullptr, "Run::finish is for Driver::command alone");
  const WorkScope scope(work_);
  const double start_s = training_->train_s();
  TrainOutcome outcome;
  try {
    listener_.stop_waits(true);
    while (!training_->at_its_end() && !advance(kAllSteps).empty()) {
      if (listener_.stop_signal() != 0) break;
    }
    if (!saved() || training_->step() == 0) save();
    listener_.stop_waits(false);
    outcome.signal = listener_.stop_signal();
    if (outcome.signal == 0) {
      outcome.values = scores_->score_end();
      outcome.scored = scores_->last_part;
      outcome.frame_psnr_db = scores_->frame_psnr_db;
    }
    outcome.step = training_->step();
    outcome.train_s = training_->train_s();
    outcome.trained_s = training_->train_s() - start_s;
    outcome.run_dir = run_dir();
    outcome.peak_bytes = peak_resident_bytes();
    if (outcome.signal == 0) outcome.report_path = listener_.write_report(*folder_, session_, scores_->report_frames);
  } catch (Error& error) {
    add_what_is_left(error);
    throw;
  }
  return outcome;
}

// A write that fails ends the run; the message then states what is left of it.
void Run::add_what_is_left(Error& error) const {
  const bool lost = dynamic_cast<const RankLost*>(&error) != nullptr;
  const bool writing = error.kind() == ErrorKind::io || error.kind() == ErrorKind::cannot_create;
  if (!lost && !(writing && error.message().starts_with("cannot "))) return;
  // A save has said it.
  const std::string kept = lost || error.context().empty() ? checkpoints_->kept_text() + "; " : "";
  error.while_doing(fmt::format("training ended at step {} ({}resume with `semfield train --resume {}`{})",
                                training_->step(), kept, shell_word(run_dir()),
                                lost ? ", with any number of processes" : ""));
}

}  // namespace semfield
