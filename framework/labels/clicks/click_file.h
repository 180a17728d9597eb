// The file of a run's clicks: which one it is, whether it is still the one that training knew, and who may append to
// it.
#pragma once

#include <optional>
#include <string>

#include "labels/clicks/click_log.h"
#include "labels/training_labels.h"

namespace semfield {

/// For a run in `run_dir`: its own file is written down as "clicks.jsonl", so a folder that is moved or copied has its
/// own; any other file as an absolute path.
void settle_click_file(LabelConfig& labels, const std::string& run_dir);

/// What the checkpoint of a run says of its clicks.
struct ClicksTrained {
  bool any_checkpoint = false;
  std::optional<EventsKnown> known;  ///< none: there were none, or an earlier version wrote it
};
/// Throws Error(no_input) where training knew clicks and their file is missing or empty, and where a run without room
/// for classes lacks the file; warns where the file does not begin with the events that training knew. Further events
/// are no change.
void require_clicks(const ClicksTrained& trained, const LabelConfig& labels, const std::string& run_dir,
                    Diagnostics& diagnostics);

/// Opens the file to append to it. Throws as ClickLog::open, Error(cannot_create) for a file in the folder of another
/// run, and for one that has grown since `labels` read it.
ClickLog open_click_log(const LabelConfig& labels, const std::string& run_dir, Diagnostics& diagnostics);

}  // namespace semfield
