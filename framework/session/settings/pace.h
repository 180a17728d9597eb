// How many steps fit into the time that a run was asked to train, from the rate of its own steps.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>

namespace semfield {

/// Reads no clock: it is given seconds of training. The number of steps is settled after a tenth of the time, once
/// the rate holds still, and after a quarter of it at the latest: steps become faster as space empties. Where the rate
/// has changed since for longer than a moment, so that the end would miss the time by more than a twelfth of it, the
/// number is settled anew.
class Pace {
 public:
  /// For what is trained between two times of training, in seconds.
  Pace(double begin_s, double until_s);

  /// After steps were made: `step` of them in `train_s` seconds of training. `end`: steps of the run at its end, 0
  /// while they are not settled. Returns the end where it is settled now.
  std::optional<std::int64_t> made(std::int64_t step, double train_s, std::int64_t end);

  /// Of the last tenth of the time; 0 before two steps were made.
  double steps_per_s() const;

 private:
  struct Mark {
    double s = 0;
    std::int64_t step = 0;
  };
  bool still() const;
  double misses_by(double steps_per_s, std::int64_t end) const;
  std::int64_t end_at_this_rate() const;

  double begin_s_, until_s_, share_s_;
  std::deque<Mark> marks_;  // one a share of the time, newest last
  Mark settled_;            // when the number was settled last
};

}  // namespace semfield
