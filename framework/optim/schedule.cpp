// Learning-rate schedules in closed form: a function of the step alone, so a resumed run needs no state.
#include "optim/schedule.h"

#include <algorithm>
#include <cmath>

namespace semfield {

void describe(ParamVisitor& visit, ScheduleParams& params) {
  SEMFIELD_PARAM(visit, params, kind, "how the learning rate falls");
  SEMFIELD_PARAM(visit, params, factor, "multiplier of the learning rate after decay_steps", {0, 1});
  SEMFIELD_PARAM(visit, params, decay_steps, "steps until the multiplier is `factor`", {1, 1e12});
  SEMFIELD_PARAM(visit, params, warmup_steps, "steps of linear rise at the start; 0 = none", {0, 1e12});
}

double schedule_factor(const ScheduleParams& params, std::int64_t step) {
  constexpr double kPi = 3.14159265358979323846;
  const double progress = static_cast<double>(step) / static_cast<double>(params.decay_steps);
  double factor = 1;
  if (params.kind == ScheduleKind::exponential) {
    factor = std::pow(params.factor, progress);
  } else if (params.kind == ScheduleKind::cosine) {
    factor = params.factor + (1 - params.factor) * 0.5 * (1 + std::cos(kPi * std::min(progress, 1.0)));
  }
  if (step < params.warmup_steps) factor *= static_cast<double>(step + 1) / static_cast<double>(params.warmup_steps);
  return factor;
}

}  // namespace semfield
