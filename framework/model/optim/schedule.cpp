// Learning-rate schedules in closed form: a function of the step alone, so a resumed run needs no state.
#include "model/optim/schedule.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace semfield {

void describe(ParamVisitor& visit, ScheduleLeg& leg) {
  SEMFIELD_PARAM(visit, leg, start, "first step of the leg, counted from 0", {0, 1e12});
  SEMFIELD_PARAM(visit, leg, rate, "multiplier of the learning rate that it begins with", {0, 1});
  SEMFIELD_PARAM(visit, leg, hold_until, "step until which that rate is held", {0, 1e12});
  SEMFIELD_PARAM(visit, leg, end,
                 "steps of the run at the leg's end, where the multiplier is `factor`; 0: settled by until_s",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, leg, until_s,
                 "seconds of training of the whole run at the leg's end; 0: it was asked for in steps", {0, 1e9});
}

void describe(ParamVisitor& visit, ScheduleParams& params) {
  SEMFIELD_PARAM(visit, params, kind, "how the learning rate falls");
  SEMFIELD_PARAM(visit, params, factor, "multiplier of the learning rate from decay_steps on", {0, 1});
  SEMFIELD_PARAM(visit, params, decay_steps,
                 "steps until the multiplier is `factor`, where it stays; 0: train.steps, and run.yaml has the number",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, params, hold_steps,
                 "steps before the rate begins to fall; train.time_s settles them with train.steps", {0, 1e12});
  SEMFIELD_PARAM(visit, params, warmup_steps, "steps of linear rise at the start; 0 = none", {0, 1e12});
}

namespace {

// Of the way from `from` to `factor`.
double fallen(ScheduleKind kind, double from, double factor, double progress) {
  constexpr double kPi = 3.14159265358979323846;
  if (kind == ScheduleKind::exponential) return from > 0 ? from * std::pow(factor / from, progress) : factor;
  if (kind == ScheduleKind::cosine) return factor + (from - factor) * 0.5 * (1 + std::cos(kPi * progress));
  return from;
}

}  // namespace

double schedule_factor(const ScheduleParams& params, std::int64_t step) {
  ScheduleLeg leg{0, 1, params.hold_steps, params.decay_steps, 0};
  for (const ScheduleLeg& later : params.legs)
    if (step >= later.start) leg = later;
  double factor = leg.rate;
  if (leg.end > 0 && step > leg.hold_until) {
    const double progress =
        step < leg.end ? static_cast<double>(step - leg.hold_until) / static_cast<double>(leg.end - leg.hold_until) : 1;
    factor = fallen(params.kind, leg.rate, params.factor, progress);
  }
  if (step < params.warmup_steps) factor *= static_cast<double>(step + 1) / static_cast<double>(params.warmup_steps);
  return factor;
}

std::int64_t step_of_share(double share, std::int64_t steps, const ScheduleParams& params) {
  if (share <= 0) return 0;
  if (steps <= 0) return std::numeric_limits<std::int64_t>::max();
  return std::max(params.hold_steps, static_cast<std::int64_t>(std::ceil(share * static_cast<double>(steps))));
}

}  // namespace semfield
