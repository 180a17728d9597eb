// Learning rate over the steps of a run.
#pragma once

#include <array>
#include <cstdint>
#include <string_view>

#include "config/params.h"

namespace semfield {

enum class ScheduleKind : std::uint8_t { constant, exponential, cosine };

template <>
struct ChoiceNames<ScheduleKind> {
  static constexpr std::array<std::string_view, 3> names{"constant", "exponential", "cosine"};
};

struct ScheduleParams {
  ScheduleKind kind = ScheduleKind::exponential;
  double factor = 0.1;
  std::int64_t decay_steps = 250000;
  std::int64_t warmup_steps = 0;
};
void describe(ParamVisitor& visit, ScheduleParams& params);

/// Multiplier of the learning rate at `step` (0-based):
///   constant     1
///   exponential  factor^(step / decay_steps), going on past decay_steps
///   cosine       factor + (1 - factor) (1 + cos(pi min(step / decay_steps, 1))) / 2
/// times (step + 1) / warmup_steps while step < warmup_steps.
double schedule_factor(const ScheduleParams& params, std::int64_t step);

}  // namespace semfield
