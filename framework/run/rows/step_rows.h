// Rows of metrics.jsonl from the losses of steps: one every report.log_every_steps, with means since the row before.
#pragma once

#include <cstdint>
#include <optional>

#include "run/metrics_log.h"
#include "session/session.h"

namespace semfield {

class StepRows {
 public:
  /// Borrows; `train_s`: seconds of training so far.
  StepRows(const Session& session, double train_s) : session_(session), window_start_s_(train_s) {}

  /// Steps from `step` to the next row.
  std::int64_t steps_until_row(std::int64_t step) const;
  /// The row that step `step` completes, if it does. To be called for every step; `train_s` is of now.
  std::optional<MetricsRow> add(const StepLosses& losses, std::int64_t step, double train_s);
  /// Seconds that were training and no steps: they do not count for rays_per_s.
  void leave_out(double seconds) { window_start_s_ += seconds; }

 private:
  const Session& session_;
  double mse_sum_ = 0, window_start_s_ = 0;
  std::int64_t steps_ = 0;
};

}  // namespace semfield
