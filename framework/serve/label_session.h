// A scene that is labelled while its field trains: one thread trains, any others click, look and query.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "labels/clicks/annotations.h"
#include "plugin/registry.h"
#include "run/run_folder.h"
#include "run/run.h"
#include "serve/label_loop.h"
#include "session/session.h"

namespace semfield {

struct LabelSessionOptions {
  std::string run_dir;  ///< made, or gone on with where it is a run of such a session
  int class_room = 0;   ///< most classes; 0: 32. Never fewer than the scene has
};

/// The run's folder holds run.yaml, clicks.jsonl, metrics.jsonl and checkpoints, so every verb works on it while the
/// session goes on and afterwards.
class LabelSession {
 public:
  /// Opens scene and run; `listener` may be null. Throws as open_session and Training do.
  LabelSession(RunConfig config, Registry& registry, const LabelSessionOptions& options, RunListener* listener);
  ~LabelSession();
  LabelSession(const LabelSession&) = delete;
  LabelSession& operator=(const LabelSession&) = delete;

  // From any thread:

  /// Stored and synced before it returns; false: an event of this id was there already. Throws Error: data for an event
  /// that is wrong, io where it could not be stored; nothing has changed then.
  bool apply(const LabelEvent& event);
  std::shared_ptr<const LabelState> state() const;
  /// The state once its revision is above `after`, or after `most` as it is then.
  std::shared_ptr<const LabelState> wait_state(std::uint64_t after, std::chrono::milliseconds most) const;
  /// Waits for the thread that trains, until `abandoned` (checked several times per second) says that nobody wants the
  /// picture any more. Quick pictures come before those of PictureRequest::full; of more than 16 that wait the oldest
  /// is stale. Throws Error for a request that is wrong or a training that has failed.
  Picture picture(const PictureRequest& request, const std::function<bool()>& abandoned = {});
  /// The view's frame, in SceneInfo::frames.
  int frame_of(int view) const;
  FreeCamera camera_of(int view) const;
  /// Number of the view that shows a frame of the scene; -1: none.
  int view_of(int frame) const;
  /// Writes a checkpoint, and returns when it is there.
  void save();
  /// run() returns after its checkpoint.
  void stop();
  const std::string& run_dir() const;
  /// What was opened; its frames and cameras do not change, all else belongs to the thread that trains.
  const Session& opened() const;

  /// Trains until stop(), or until an error, which is in the state then; pictures and events go on until stop(). Files
  /// that cannot be written end nothing: the state says so, and they are tried again. Throws write_error where the last
  /// checkpoint cannot be written either.
  void run();
  /// What training has ended with, once run() has returned.
  std::optional<Error> failure() const;

 private:
  struct Parts;
  std::unique_ptr<Parts> parts_;
};

// What a labelling session writes for the report of its run.

/// labelling.json and the pictures of the frames with the most clicks: photograph with clicks, labels, entropy. `state`
/// has classes, marks and the step. Throws write_error.
void write_session_record(const RunFolder& folder, const Session& session, LabelLoop& loop, const LabelState& state);

}  // namespace semfield
