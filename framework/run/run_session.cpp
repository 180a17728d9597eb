#include "run/run_session.h"

#include <algorithm>
#include <filesystem>
#include <utility>

#include "core/findings.h"
#include "labels/clicks/click_file.h"

namespace semfield {

namespace {

// A run that has room for classes and a folder keeps its clicks there.
OpenedForTraining open(RunConfig config, Registry& registry, const RunSessionOptions& options, RunListener& listener) {
  TrainRequest request;
  request.out_dir = options.run_dir;
  request.resume = options.resume;
  request.keep = options.keep;
  request.more = options.more;
  LabelParams& labels = config.labels.selection;
  if (labels.clicks.empty() && labels.class_room > 0 && !options.run_dir.empty())
    labels.clicks = (std::filesystem::absolute(options.run_dir) / kClickFile).string();
  if (options.run_dir.empty() && !config.self_training.at.empty())
    throw Error(ErrorKind::usage, "run.folder.unnamed",
                "train.self_training: its rounds are written to the run's folder, and this run has none",
                "name a folder when the run is opened");
  return open_for_training(std::move(config), registry, request, listener);
}

}  // namespace

RunSession::RunSession(RunConfig config, Registry& registry, const RunSessionOptions& options, RunListener& listener)
    : RunLoop(open(std::move(config), registry, options, listener), registry, &listener, {}),
      annotations_(session().config.labels.clicks) {}

bool RunSession::apply(const LabelEvent& event) {
  const LabelConfig& labels = session().config.labels;
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
  training().set_clicks(next, frames);
  try {
    clicks_->append(event);
  } catch (...) {
    training().set_clicks(*annotations_, frames);
    throw;
  }
  annotations_ = std::move(next);
  try {
    write_classes();
  } catch (const Error& error) {  // the event is stored already: a later one writes the file
    listener().warning("classes.yaml is behind the classes: " + shown(error));
  }
  return true;
}

}  // namespace semfield
