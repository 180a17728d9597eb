// The thread of a labelling session that trains: steps, what is learned from clicks between them, and the run's folder.
#pragma once

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "labels/clicks/annotations.h"
#include "run/checkpoint_store.h"
#include "run/metrics_log.h"
#include "run/run_start.h"
#include "serve/label_loop.h"
#include "serve/label_state.h"
#include "serve/view_pictures.h"

namespace semfield {

class LabelRun {
 public:
  /// `opened` has room for classes (scene.labels.class_room), so its network has semantics.
  LabelRun(OpenedForTraining opened, Registry& registry, TrainingListener* listener);

  const Session& session() const { return training_.session(); }
  const RunFolder& folder() const { return folder_; }
  const LabelLoop& loop() const { return loop_; }
  ViewPictures& pictures() { return pictures_; }
  std::int64_t step() const { return training_.step(); }

  /// Labels, semantics and the next question are those of `annotations` from now on.
  void take(const Annotations& annotations);
  /// Trains for about this long, while there is something to train; false: there is not.
  bool train(double budget_s);
  /// Surfaces that are due, within the share of time that training grants them; in a pause between clicks what was
  /// learned quickly is learned well; when nobody has clicked for long the temperature. True when labels or questions
  /// have changed.
  bool tend(bool looked_at, bool pause, bool quiet);
  /// Everything of the state but events, marks and names.
  void describe(LabelState& state) const;
  /// Checkpoint and log.
  void save();
  bool save_is_due() const;

 private:
  using Clock = std::chrono::steady_clock;
  // What the pool's probabilities add up to; made when they change.
  struct Summary {
    std::vector<double> area, sure;  // of classes: share of the surface, and mean confidence
    std::vector<double> entropy;     // of views
  };
  void summarise();
  bool still_learns() const;
  void record(std::span<const StepLosses> steps);
  void ask();
  std::vector<LabelledPixels> named_by(const Annotations& annotations) const;
  std::vector<LabelledPixels> given_labels() const;

  Registry& registry_;
  RunFolder folder_;
  Training training_;
  LabelLoop loop_;
  ViewPictures pictures_;
  CheckpointStore checkpoints_;
  std::optional<MetricsLog> log_;
  std::vector<int> view_of_frame_;
  std::vector<LabelledPixels> clicks_;  // and given labels
  std::vector<LabelledPixels> given_;
  std::vector<std::uint64_t> marked_;  // frames, by a checksum of their marks, to tell which have changed
  bool taken_ = false, learned_quickly_ = false;
  std::uint64_t skips_ = 0;  // a checksum of their ids
  std::size_t marks_ = 0, fitted_at_ = 0;
  std::optional<ProposalState> proposal_;
  std::uint64_t asked_ = 0;
  std::int64_t changed_step_ = -1, saved_step_ = -1;
  double mse_ = 0, loss_ = 0, rays_per_s_ = 0, step_s_ = 0.01, tending_s_ = 0, refining_s_ = 0, training_s_ = 0;
  std::vector<HistoryRow> history_;
  Summary summary_;
  Clock::time_point last_save_ = Clock::now();
};

}  // namespace semfield
