// How long a run trains and what its learning rate does meanwhile: asked for in steps or in seconds, settled in steps.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/view.h"
#include "session/settings/run_config.h"

namespace semfield {

/// Steps that a run trains when nobody says how many: about a minute on two cores, some seconds on a GPU.
inline constexpr std::int64_t kStepsOnCpu = 3000, kStepsOnGpu = 20000;

/// What somebody asks a run for; one of both, or neither.
struct AskedLength {
  std::int64_t steps = 0;
  double seconds = 0;
  bool any() const { return steps > 0 || seconds > 0; }
};

/// The list train.schedule.legs of a configuration, and back; an error for legs that do not follow each other.
std::vector<ScheduleLeg> read_legs(const ConfigNode& legs, Diagnostics& diagnostics);
ConfigNode legs_config(const std::vector<ScheduleLeg>& legs);

/// Steps of the run at its end; 0: not settled yet.
std::int64_t last_step(const RunConfig& config);
/// Seconds of training of the run at its end, as they were asked for; 0: nobody did.
double end_s(const RunConfig& config);

/// "3000 steps", "20 s of training".
std::string length_text(const RunConfig& config);

/// Length and schedule of a run that begins: the rate falls to its factor at the end.
void ask(RunConfig& config, const AskedLength& asked);
/// That much more for a run that has made `step` steps in `train_s` seconds: a further leg, which begins at half of the
/// first rate where the rate has fallen below that, and falls to the factor at the new end. What was left of the length
/// so far is not trained beside it.
void ask_more(RunConfig& config, const AskedLength& asked, std::int64_t step, double train_s);

/// When a session opens: the device settles a length that nobody asked for, and the schedule follows train.steps. Until
/// a time has been settled the rate is held. A sentence about the device's choice, or "".
std::string resolve_length(RunConfig& config, Device device);
/// A run that was asked for in seconds, and has made `step` steps, ends at `end`: it holds its rate until now, and
/// falls from now on. Also where that had been settled before.
void settle(RunConfig& config, std::int64_t step, std::int64_t end);

/// Errors for what can never work in a run of this length: a warm-up beyond its end, terms of the loss that begin
/// there.
void check_length(const RunConfig& config, Diagnostics& diagnostics);

}  // namespace semfield
