#include "labels/clicks/click_file.h"

#include <fmt/format.h>

#include <filesystem>

#include "core/text.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

fs::path place_of(const fs::path& path) {
  std::error_code unknown;
  const fs::path place = fs::weakly_canonical(fs::absolute(path), unknown);
  return unknown ? fs::absolute(path).lexically_normal() : place;
}

std::string events_text(std::int64_t events) { return fmt::format("{} event{}", events, events == 1 ? "" : "s"); }

}  // namespace

void settle_click_file(LabelConfig& labels, const std::string& run_dir) {
  const std::string file = labels.click_file();
  labels.run_dir = fs::absolute(run_dir).lexically_normal().string();
  if (file.empty()) return;
  labels.selection.clicks = place_of(file) == place_of(fs::path(run_dir) / kClickFile) ? kClickFile : file;
}

void require_clicks(const ClicksTrained& trained, const LabelConfig& labels, const std::string& run_dir,
                    Diagnostics& diagnostics) {
  const std::string file = labels.click_file(), other = "--set scene.labels.clicks=FILE";
  const bool room = labels.selection.class_room > 0;
  // A checkpoint of an earlier version does not say what it knew; its run has had the file from the start.
  const bool unknown = trained.any_checkpoint && !trained.known;
  if (!file.empty() && !is_there(file) && (unknown || !room)) {
    throw Error(ErrorKind::no_input, "labels.clicks.missing",
                fmt::format("'{}' is not there, where scene.labels.clicks of the run '{}' points", file, run_dir),
                fmt::format("put the file back, or say where it is: {}{}", other,
                            unknown ? "; where nobody ever clicked, make an empty one" : ""));
  }
  if (!trained.known || trained.known->events == 0) return;
  Diagnostics ignored;  // told when the labels are read
  EventsKnown now;
  bool begins = false;
  for (const LabelEvent& event : is_there(file) ? read_click_log(file, ignored) : std::vector<LabelEvent>()) {
    now.add(event);
    begins = begins || now == *trained.known;
  }
  if (now.events == 0) {
    throw Error(
        ErrorKind::no_input, "labels.clicks.missing",
        fmt::format("the run '{}' has learned from {} of clicks, and {}", run_dir, events_text(trained.known->events),
                    file.empty() ? "scene.labels.clicks names no file"
                                 : fmt::format("'{}' {}", file, is_there(file) ? "is empty" : "is not there")),
        fmt::format("put the file back, or say where it is: {}", other));
  }
  if (begins) return;
  diagnostics.warning("labels.clicks.changed", "scene.labels.clicks",
                      fmt::format("'{}' does not begin with the {} that the run has learned from: other clicks", file,
                                  events_text(trained.known->events)),
                      fmt::format("put the run's own file back, or say where it is: {}", other));
}

ClickLog open_click_log(const LabelConfig& labels, const std::string& run_dir, Diagnostics& diagnostics) {
  const std::string file = labels.click_file();
  const fs::path folder = place_of(file).parent_path();
  if (folder != place_of(run_dir) && is_there(folder / "run.yaml")) {
    throw Error(ErrorKind::cannot_create, "labels.clicks.foreign",
                fmt::format("the clicks in '{}' are those of another run, so none are added to them", file),
                fmt::format("continue that run, or a copy of its folder; or name a file of this run's own: "
                            "--set scene.labels.clicks={}",
                            shell_word((fs::path(run_dir) / kClickFile).string())));
  }
  ClickLog log = ClickLog::open(file, diagnostics);
  EventsKnown known;
  for (const LabelEvent& event : log.events()) known.add(event);
  if (labels.clicks && known != labels.clicks->known())
    throw Error(ErrorKind::cannot_create, "labels.clicks.changed",
                fmt::format("'{}' has changed while the scene was opened", file), "start the program again");
  return log;
}

}  // namespace semfield
