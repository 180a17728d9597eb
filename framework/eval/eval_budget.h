// How much of a run's time its evaluations may take, and what fits into that.
#pragma once

#include <cstdint>

namespace semfield {

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
  /// Seconds that the last evaluation may take after `train_s` seconds of training; infinite where nothing bounds it.
  double left_s(double train_s) const;
  /// The least stride with which `pixels` fit into `budget_s`, at most `most`; 1 where the cost is not known.
  std::int32_t stride_within(double budget_s, double pixels, std::int32_t most) const;

 private:
  double share_, time_s_;
  double spent_s_ = 0, s_per_px_ = -1;
};

}  // namespace semfield
