// The thread of a labelling session that trains: steps, what is learned from clicks between them, and the run's folder.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "labels/clicks/annotations.h"
#include "run/run.h"
#include "serve/label_loop.h"
#include "serve/view_pictures.h"

namespace semfield {

class LabelRun {
 public:
  /// `run`, by Driver::page, has a folder and room for classes (scene.labels.class_room), so its network has semantics.
  explicit LabelRun(std::unique_ptr<Run> run);

  const Session& session() const { return training_.session(); }
  const RunFolder& folder() const { return *run_->folder(); }
  const LabelLoop& loop() const { return loop_; }
  ViewPictures& pictures() { return pictures_; }
  std::int64_t step() const { return training_.step(); }

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
  /// What the run's report says of the labelling; `state` has the classes and marks.
  void write_record(LabelState state);

 private:
  using Clock = std::chrono::steady_clock;
  // What the pool's probabilities add up to; made when they change.
  struct Summary {
    std::vector<double> area, sure;  // of classes: fraction of the surface, and mean confidence
    std::vector<double> entropy;     // of views
  };
  void summarise();
  bool still_learns() const;
  void show(std::span<const StepLosses> steps);
  void ask();
  // Once the places of the clicks are known, which are looked for for about this long; true when it has learned.
  bool learn_new(double budget_s);
  bool fit_a_fold();
  void name_pixels(const Annotations& annotations, std::span<const int> changed);
  std::vector<LabelledPixels> given_labels() const;
  // What nobody shall name in these frames.
  void ignore_pixels(const Annotations& annotations, std::span<const int> frames);

  std::unique_ptr<Run> run_;
  Training& training_;
  LabelLoop loop_;
  ViewPictures pictures_;
  std::vector<int> view_of_frame_;
  std::vector<LabelledPixels> clicks_;  // and given labels
  std::vector<LabelledPixels> given_;
  std::vector<std::vector<LabelledPixels>> named_;  // of each frame, by its marks
  std::vector<std::uint64_t> marked_;               // frames, by a checksum of their marks, to see which have changed
  bool taken_ = false, unlearned_ = false, learned_quickly_ = false;
  std::uint64_t skips_ = 0;  // a checksum of their ids
  std::size_t marks_ = 0, fitted_at_ = 0;
  int fold_ = 0;  // of the fit that is under way
  std::vector<HeldBack> held_back_;
  std::optional<ProposalState> proposal_;
  std::uint64_t asked_ = 0;
  std::int64_t changed_step_ = -1;
  double mse_ = 0, loss_ = 0, rays_per_s_ = 0, step_s_ = 0.01, tending_s_ = 0, refining_s_ = 0, training_s_ = 0;
  std::vector<HistoryRow> history_;
  Summary summary_;
  std::optional<Clock::time_point> failed_to_keep_;
};

}  // namespace semfield
