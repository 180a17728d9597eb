// How much of a run's time its evaluations may take, and what fits into that.
#pragma once

#include <cstdint>

namespace semfield {

/// Frames and pixels of an evaluation that was cut to its time.
struct EvalCut {
  double share = 1;         ///< of the frames asked for; at least one frame is scored
  std::int32_t stride = 1;  ///< of the pixels (pixel_stride.h)
};

/// Evaluations while training get half of `share` of the seconds trained, the last one what is then left of
/// (1 + share) times the time that the run was asked for. A share of 0 bounds nothing; without a time the last one is
/// not bounded.
class EvalBudget {
 public:
  EvalBudget(double share, double time_s) : share_(share), time_s_(time_s) {}

  /// An evaluation of so many pixels took so long.
  void spend(double seconds, double pixels);
  bool knows_cost() const { return s_per_px_ >= 0; }
  bool bounds_samples() const { return share_ > 0; }
  bool bounds_last() const { return share_ > 0 && time_s_ > 0; }

  /// Pixels of a sample that is scored every `every_s` seconds, so that it keeps to its share.
  std::int32_t sample_stride(double pixels, double every_s, std::int32_t most) const;
  /// Whether the samples so far kept to their share of `trained_s` seconds of training.
  bool has_time_for_sample(double trained_s) const { return !bounds_samples() || spent_s_ <= share_ / 2 * trained_s; }
  /// What fits into the rest of the time after `train_s` seconds of training. `pixels` of `frames` frames are asked
  /// for.
  EvalCut last(double pixels, std::int64_t frames, double train_s, std::int32_t most_stride) const;

 private:
  double share_, time_s_;
  double spent_s_ = 0, s_per_px_ = -1;
};

}  // namespace semfield
