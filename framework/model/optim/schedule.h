// Learning rate over the steps of a run, which may have several legs.
#pragma once

#include <array>
#include <cstdint>
#include <string_view>
#include <vector>

#include "config/params.h"

namespace semfield {

enum class ScheduleKind : std::uint8_t { constant, exponential, cosine };

template <>
struct ChoiceNames<ScheduleKind> {
  static constexpr std::array<std::string_view, 3> names{"constant", "exponential", "cosine"};
};

/// What a run trains beyond the length that it began with, or after its length was settled anew.
struct ScheduleLeg {
  std::int64_t start = 0;
  double rate = 1;
  std::int64_t hold_until = 0;
  std::int64_t end = 0;
  double until_s = 0;
  bool operator==(const ScheduleLeg&) const = default;
};
void describe(ParamVisitor& visit, ScheduleLeg& leg);

struct ScheduleParams {
  ScheduleKind kind = ScheduleKind::exponential;
  double factor = 0.1;
  std::int64_t decay_steps = 250000;
  std::int64_t hold_steps = 0;
  std::int64_t warmup_steps = 0;
  std::vector<ScheduleLeg> legs;  ///< by ascending start; no parameter of describe()
};
void describe(ParamVisitor& visit, ScheduleParams& params);

/// Multiplier of the learning rate at `step` (0-based). With p = (step - hold_steps) / (decay_steps - hold_steps),
/// which is 0 before and 1 behind:
///   constant     1
///   exponential  factor^p
///   cosine       factor + (1 - factor) (1 + cos(pi p)) / 2
/// times (step + 1) / warmup_steps while step < warmup_steps. From the start of a leg on, the leg's own hold_until and
/// end are meant, and its rate in place of 1. Without an end (0: not settled yet) the rate is held.
double schedule_factor(const ScheduleParams& params, std::int64_t step);

/// First step, 0-based, of what begins after `share` of a run of `steps` steps: never while the rate is held before its
/// first fall, because until then nobody may know `steps` (0), and what waits for a share of them waits.
std::int64_t step_of_share(double share, std::int64_t steps, const ScheduleParams& params);

}  // namespace semfield
