#include "run/rows/step_rows.h"

#include <algorithm>
#include <cmath>

#include "session/settings/run_length.h"

namespace semfield {

std::int64_t StepRows::steps_until_row(std::int64_t step) const {
  const std::int64_t every = session_.config.report.log_every_steps;
  return every - step % every;
}

std::optional<MetricsRow> StepRows::add(const StepLosses& losses, std::int64_t step, double train_s) {
  const RunConfig& config = session_.config;
  mse_sum_ += losses.mse;
  ++steps_;
  if (step % config.report.log_every_steps != 0 && step != last_step(config)) return std::nullopt;
  const double span = std::max(train_s - window_start_s_, 1e-9);
  MetricsRow row;
  row.step = step;
  row.train_s = train_s;
  row.set("loss", losses.total);
  row.set("loss_color", losses.color);
  if (session_.pipeline->has_semantics()) row.set("loss_semantic", losses.semantic);
  const std::vector<LossEntry>& terms = config.losses;
  for (std::size_t i = 0; i < terms.size(); ++i) {  // without a value while the term has not begun
    row.set("loss_" + terms[i].type, (losses.active >> i & 1U) != 0 ? std::optional(losses.terms[i]) : std::nullopt);
  }
  row.set("psnr", -10 * std::log10(mse_sum_ / static_cast<double>(steps_)));
  row.set("rays_per_s", static_cast<double>(steps_ * config.train.rays) / span);
  row.set("samples_per_ray", static_cast<double>(losses.samples) / static_cast<double>(config.train.rays));
  mse_sum_ = 0;
  steps_ = 0;
  window_start_s_ = train_s;
  return row;
}

}  // namespace semfield
