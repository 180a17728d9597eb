// Drive a run step by step from a program: the loop of a run, with clicks, and a folder once it has one.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "labels/clicks/click_log.h"
#include "run/run_loop.h"

namespace semfield {

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
