#include "run/run_session.h"

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <utility>

#include "classes/class_names.h"
#include "labels/clicks/click_file.h"
#include "settings/run_identity.h"
#include "system/files.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;

// A run that has room for classes and a folder keeps its clicks there.
OpenedForTraining open(RunConfig config, Registry& registry, const RunSessionOptions& options,
                       TrainingListener& listener) {
  TrainRequest request;
  request.out_dir = options.run_dir;
  request.resume = options.resume;
  request.keep = options.keep;
  request.more = options.more;
  LabelParams& labels = config.labels.selection;
  if (labels.clicks.empty() && labels.class_room > 0 && !options.run_dir.empty())
    labels.clicks = (fs::absolute(options.run_dir) / kClickFile).string();
  if (options.run_dir.empty() && !config.self_training.at.empty())
    throw Error(ErrorKind::usage,
                "train.self_training: its rounds are written to the run's folder, and this run has none",
                "name a folder when the run is opened");
  return open_for_training(std::move(config), registry, request, listener);
}

std::string place_of(const std::string& folder) { return fs::weakly_canonical(fs::absolute(folder)).string(); }

}  // namespace

RunSession::RunSession(RunConfig config, Registry& registry, const RunSessionOptions& options,
                       TrainingListener& listener)
    : RunSession(open(std::move(config), registry, options, listener), registry, listener) {}

RunSession::RunSession(OpenedForTraining opened, Registry& registry, TrainingListener& listener)
    : registry_(registry),
      listener_(listener),
      folder_(std::move(opened.folder)),
      training_(std::move(opened.session), &listener, std::move(opened.inputs)),
      self_training_(session(), training_.rays(), folder_ ? folder_->self_labels_path() : ""),
      step_rows_(std::in_place, session(), 0),
      annotations_(session().config.labels.clicks) {
  const WorkSettings work = session().work();
  const WorkScope scope(work);
  if (!folder_) return;
  self_training_.resume(opened.point.step(), opened.point.facts ? opened.point.facts->self_labels : "");
  if (opened.point.facts) training_.load(opened.point.path);
  step_rows_.emplace(session(), training_.train_s());
  write_records(*folder_, opened.point);
  log_.emplace(MetricsLog::resume(folder_->metrics_path(), training_.step()));
}

void RunSession::write_records(const RunFolder& folder, const ResumePoint& point) {
  write_run_records(folder, training_, registry_, point);
  classes_written_ = named_classes(session().scene.info.classes).to_yaml();
  write_label_counts(folder, session(), self_training_);
}

std::span<const StepLosses> RunSession::advance(std::int64_t most, const std::function<bool()>& stop) {
  using Clock = std::chrono::steady_clock;
  const WorkSettings work = session().work();
  const WorkScope scope(work);
  const std::int64_t before = training_.step();
  if (self_training_.due(before)) {
    const Clock::time_point start = Clock::now();
    if (!self_training_.make_round(before, {{}, stop})) return {};
    const double spent_s = std::chrono::duration<double>(Clock::now() - start).count();
    training_.add_train_s(spent_s);
    step_rows_->leave_out(spent_s);
    listener_.note(self_training_.rounds().back().text());
    write_label_counts(*folder_, session(), self_training_);
  }
  const std::int64_t ahead =
      self_training_.steps_until_due(before, std::min(most, step_rows_->steps_until_row(before)));
  const std::span<const StepLosses> made = training_.advance(ahead);
  if (training_.take_settled() && folder_) write_run_config(*folder_, session().config, registry_);
  for (std::size_t i = 0; i < made.size(); ++i) {
    const std::optional<MetricsRow> row =
        step_rows_->add(made[i], before + 1 + static_cast<std::int64_t>(i), training_.train_s());
    if (!row) continue;
    rows_.push_back(*row);
    if (log_) log_->append(*row);
  }
  return made;
}

void RunSession::train_more(const AskedLength& asked) {
  training_.train_more(asked);
  if (folder_) write_run_config(*folder_, session().config, registry_);
}

std::string RunSession::write_checkpoint(const RunFolder& folder) {
  const std::vector<TensorRef> tensors = training_.state();
  CheckpointFacts facts = training_.facts();
  facts.self_labels = self_training_.named();
  CheckpointStore checkpoints(folder.checkpoints_path(), session().config.report.keep_checkpoints);
  return checkpoints.save(facts.step, tensors, checkpoint_metadata(facts, identity_hash(session().config)));
}

std::string RunSession::save(const std::string& run_dir) {
  const WorkSettings work = session().work();
  const WorkScope scope(work);
  const std::string own = folder_ ? place_of(folder_->path()) : saved_in_;
  if (own.empty() && run_dir.empty())
    throw Error(ErrorKind::usage, "the run has no folder yet", "name the folder to save it in");
  const std::string place = run_dir.empty() ? own : place_of(run_dir);
  if (folder_) {
    if (place != own)
      throw Error(ErrorKind::usage, "the run has the folder '" + own + "' and cannot be saved in '" + run_dir + "'",
                  "save it in its own folder; a copy of the folder is a run too");
    log_->sync();
    return write_checkpoint(*folder_);
  }
  const bool again = place == saved_in_;
  (void)run_config_text(session().config, registry_);  // what cannot be stored leaves no folder
  training_.state();
  const RunFolder folder = again ? RunFolder::resume(place) : RunFolder::create(place);
  if (again) {
    const std::vector<CheckpointStore::Entry> there = CheckpointStore::read(folder.checkpoints_path()).list();
    if (!there.empty() && there.front().path != last_saved_)
      throw Error(ErrorKind::data,
                  "somebody went on with the run in '" + place + "': its newest checkpoint is " + there.front().path,
                  "save this one in another folder");
  }
  write_run_config(folder, session().config, registry_);
  if (!again) write_records(folder, {});
  MetricsLog log = MetricsLog::resume(folder.metrics_path(), 0);
  for (const MetricsRow& row : rows_) log.append(row);
  log.sync();
  last_saved_ = write_checkpoint(folder);
  saved_in_ = place;
  return last_saved_;
}

bool RunSession::apply(const LabelEvent& event) {
  const LabelConfig& labels = session().config.labels;
  if (!annotations_ || labels.selection.clicks.empty())
    throw Error(ErrorKind::usage, "the run has no file of clicks",
                "open it with a folder and scene.labels.class_room, or with scene.labels.clicks");
  if (!clicks_) {  // not before somebody clicks: to learn from another run's clicks is no reason to hold their file
    Diagnostics ignored;  // told when the scene was opened by the file
    clicks_.emplace(open_click_log(labels, run_dir(), ignored));
  }
  Annotations next = *annotations_;
  if (!next.apply(event)) return false;
  std::vector<int> frames = annotations_->frames_with_marks();
  for (const int frame : next.frames_with_marks())
    if (std::find(frames.begin(), frames.end(), frame) == frames.end()) frames.push_back(frame);
  training_.set_clicks(next, frames);
  try {
    clicks_->append(event);
  } catch (...) {
    training_.set_clicks(*annotations_, frames);
    throw;
  }
  annotations_ = std::move(next);
  write_classes();
  return true;
}

// The event is stored already: a file that cannot be written now is written with a later one.
void RunSession::write_classes() {
  const std::string classes = named_classes(session().scene.info.classes).to_yaml();
  if (!folder_ || classes == classes_written_) return;
  try {
    write_file_atomic(folder_->classes_path(), classes);
    classes_written_ = classes;
  } catch (const Error& error) {
    listener_.warning(std::string("classes.yaml is behind the classes: ") + error.what());
  }
}

}  // namespace semfield
