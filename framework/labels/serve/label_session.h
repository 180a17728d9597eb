// A scene that is labelled while its field trains: one thread trains, any others click, look and query.
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "formats/image_io.h"
#include "labels/clicks.h"
#include "labels/serve/label_loop.h"
#include "labels/serve/label_state.h"
#include "labels/serve/view_pictures.h"
#include "plugin/registry.h"
#include "scene/dataset.h"
#include "train/run.h"
#include "train/run_folder.h"
#include "train/session.h"

namespace semfield {

/// What a page asks of a labelling session, from several threads at once.
class LabelSource {
 public:
  virtual ~LabelSource() = default;

  /// Stored and synced before it returns; false: an event of this id was there already. Throws Error: data for an event
  /// that is wrong, io where it could not be stored; nothing has changed then.
  virtual bool apply(const LabelEvent& event) = 0;
  virtual std::shared_ptr<const LabelState> state() const = 0;
  /// The state once its revision is above `after`, or after `most` as it is then.
  virtual std::shared_ptr<const LabelState> wait_state(std::uint64_t after, std::chrono::milliseconds most) const = 0;
  /// Waits for the thread that trains, until `abandoned` (checked several times per second) says that nobody wants the
  /// picture any more. Of more than 16 that wait the oldest is stale. Throws Error for a request that is wrong or a
  /// training that has failed.
  virtual Picture picture(const PictureRequest& request, const std::function<bool()>& abandoned = {}) = 0;
  /// Photograph of a view as its file has it, or the one that trains where that is at least `most_px` long (0: as long
  /// as there is). Throws what the dataset throws, and Error(data) where the files are no longer those that were
  /// loaded.
  virtual Image<std::uint8_t> photo(int view, std::int32_t most_px) = 0;
  /// Number of the view that shows a frame of the scene; -1: none.
  virtual int view_of(int frame) const = 0;
  /// Writes a checkpoint, and returns when it is there.
  virtual void save() = 0;
};

struct LabelSessionOptions {
  std::string run_dir;            ///< made, or gone on with where it is a run of such a session
  int class_room = 0;             ///< most classes; 0: 32. Never fewer than the scene has
  std::string segments, pattern;  ///< of images, as read_segments() reads them; "": there are none
};

/// By Driver::page, with a folder and room for classes (scene.labels.class_room), so its network has semantics.
struct LabelledRun {
  std::unique_ptr<Run> run;
  std::vector<std::string> warnings;  ///< of while it was opened
  SegmentSet segments;
};

/// The run's folder holds run.yaml, clicks.jsonl, metrics.jsonl and checkpoints, so every verb works on it while the
/// session goes on and afterwards.
class LabelSession final : public LabelSource {
 public:
  /// Opens scene and run; `listener` may be null. Throws as open_session, Trainer and read_segments do.
  LabelSession(RunConfig config, Registry& registry, const LabelSessionOptions& options, RunListener* listener);
  explicit LabelSession(LabelledRun run);

  bool apply(const LabelEvent& event) override;
  std::shared_ptr<const LabelState> state() const override;
  std::shared_ptr<const LabelState> wait_state(std::uint64_t after, std::chrono::milliseconds most) const override;
  Picture picture(const PictureRequest& request, const std::function<bool()>& abandoned = {}) override;
  Image<std::uint8_t> photo(int view, std::int32_t most_px) override;
  int view_of(int frame) const override { return view_of_frame_[static_cast<std::size_t>(frame)]; }
  void save() override;

  // From any thread too:

  /// The view's frame, in SceneInfo::frames.
  int frame_of(int view) const { return loop_.views().at(static_cast<std::size_t>(view)).frame; }
  /// run() returns after its checkpoint.
  void stop();
  const std::string& run_dir() const { return run_->folder()->path(); }
  /// What was opened; its frames and cameras do not change, all else belongs to the thread that trains.
  const Session& opened() const { return training_.session(); }

  /// Trains until stop(), or until an error, which is in the state then; pictures and events go on until stop(). Files
  /// that cannot be written end nothing: the state says so, and they are tried again. Throws write_error where the last
  /// checkpoint cannot be written either.
  void run();
  /// What training has ended with, once run() has returned.
  std::optional<Error> failure() const { return failure_; }

  // Of the thread that trains, which run() is:

  const LabelLoop& loop() const { return loop_; }
  ViewPictures& pictures() { return pictures_; }
  std::int64_t step() const { return training_.step(); }
  /// Copies the events that have come, and learns from them.
  void take_events();
  /// Labels, semantics and the next question are those of `annotations` from now on; where many clicks are new, the
  /// semantics follow in the course of tend().
  void take(const Annotations& annotations);
  /// The semantics know all that was taken, as far as there is a surface.
  bool knows_all() const { return !unlearned_ || !loop_.ready(); }
  /// Trains for about this long, or until `interrupted` after some steps, while there is something to train; false:
  /// there is not.
  bool train(double budget_s, const std::function<bool()>& interrupted = {});
  /// Surfaces that are due, within the fraction of time that training grants them; clicks whose places are found; in a
  /// pause between clicks what was learned quickly is learned well; when nobody has clicked for long a fold of the
  /// clicks for the temperature. True when labels or questions have changed.
  bool tend(bool looked_at, bool pause, bool quiet);
  /// Everything of the state but events, marks and names.
  void describe(LabelState& state) const;
  /// Rows of the log and classes.yaml, where they have changed, and a checkpoint where one is due or `checkpoint`
  /// requires for it. Throws write_error; what could not be written stays due, and keep_is_due() is false for a while.
  void keep(bool checkpoint);
  bool keep_is_due() const;
  /// write_labelling_record() of now. `state` has the classes and marks.
  void write_record(LabelState state);

 private:
  using Clock = std::chrono::steady_clock;
  // A picture that somebody waits for.
  struct Order {
    PictureRequest request;
    std::optional<Picture> made;
    std::optional<Error> error;
    bool done() const { return made || error; }
  };

  // What the pool's probabilities add up to; made when they change.
  struct Summary {
    std::vector<double> area, sure;  // of classes: fraction of the surface, and mean confidence
    std::vector<double> entropy;     // of views
    double unreached = 1;
  };
  void summarise();
  bool still_learns() const;
  void ask();
  // Once the places of the clicks are known, which are looked for for about this long; true when it has learned.
  bool learn_new(double budget_s);
  bool fit_a_fold();
  // A mark with its pixels; with `painted` those alone that still have its class.
  LabelledPixels labelled(const Annotations::Mark& mark, std::span<const std::int16_t> painted = {}) const;
  void name_pixels(const Annotations& annotations, std::span<const int> changed);
  std::vector<LabelledPixels> given_labels() const;
  // What nobody shall name in these frames.
  void ignore_pixels(const Annotations& annotations, std::span<const int> frames);

  void poke();
  template <class Change>
  void publish(const Change& change);
  bool is_waited_for() const;
  void name_classes(LabelState& next) const;
  std::unique_ptr<Dataset> open_dataset() const;
  // Of the thread that trains: it serves pictures, saves, and publishes the state.
  void publish_learned(bool labels);
  void serve_orders();
  void save_if_wanted();
  template <class Work>
  void attempt(const Work& work);
  void fail(const Error& error);

  // Of the thread that trains.
  std::unique_ptr<Run> run_;
  Trainer& training_;
  LabelLoop loop_;
  ViewPictures pictures_;
  std::vector<int> view_of_frame_;
  std::vector<LabelledPixels> clicks_;  // and given labels
  std::vector<LabelledPixels> given_;
  std::vector<std::vector<LabelledPixels>> named_;  // of each frame, by its marks
  std::vector<std::uint64_t> marked_;               // frames, by a checksum of their marks, to see which have changed
  bool taken_ = false, unlearned_ = false, learned_quickly_ = false;
  std::uint64_t skips_ = 0;  // a checksum of their ids
  std::size_t fitted_at_ = 0;
  int fold_ = 0;  // of the fit that is under way
  std::vector<HeldBack> held_back_;
  std::optional<ProposalState> proposal_;
  std::uint64_t asked_ = 0;
  std::int64_t changed_step_ = -1;
  double mse_ = 0, loss_ = 0, rays_per_s_ = 0, step_s_ = 0.01, tending_s_ = 0, refining_s_ = 0, training_s_ = 0;
  Summary summary_;
  std::optional<Clock::time_point> failed_to_keep_;

  // Of events. Held while one is stored, so it is never taken by the thread that trains for longer than a copy takes.
  std::mutex events_mutex_;
  Annotations annotations_;
  ClickLog log_;

  // Of what follows up to the photographs, but for `taken_events_`, `trouble_told_` and `failure_`, which belong to the
  // thread that trains.
  mutable std::mutex mutex_;
  mutable std::condition_variable changed_;  // the state, or an order
  std::condition_variable wanted_;           // something of the thread that trains
  std::shared_ptr<const LabelState> state_;
  std::optional<std::uint64_t> taken_events_;  // that `run_` knows
  std::vector<std::shared_ptr<Order>> orders_;
  std::uint64_t saves_wanted_ = 0, saves_made_ = 0;
  std::optional<Error> save_error_;
  bool stopping_ = false, ended_ = false, poked_ = false;  // poked: look again before going to sleep
  std::string trouble_told_;
  std::optional<Error> failure_;  // of the thread that trains: it trains no longer, and responds all the same
  Clock::time_point last_event_, last_look_;

  // Photographs as their files have them, larger than those that train; opened when somebody looks at one closely.
  std::mutex photo_mutex_;
  std::unique_ptr<Dataset> dataset_;
  int kept_frame_ = -1;
  Image<std::uint8_t> kept_photo_;
};

}  // namespace semfield
