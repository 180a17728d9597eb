#include "session/settings/run_length.h"

#include <fmt/format.h>

#include <algorithm>

namespace semfield {

namespace {

constexpr double kFurtherRate = 0.5;  // of a leg, where the rate has fallen below it: it learns, and forgets little

}  // namespace

std::vector<ScheduleLeg> read_legs(const ConfigNode& list, Diagnostics& diagnostics) {
  const std::string path = "train.schedule.legs";
  std::vector<ScheduleLeg> legs;
  if (list.is_null()) return legs;
  if (!list.is_list()) {
    diagnostics.error("config.value.type", list.location().text(),
                      path + ": expected a list of maps {start, rate, hold_until, end}",
                      "`semfield train --resume RUN --time T` writes it");
    return legs;
  }
  for (std::size_t i = 0; i < list.items().size(); ++i) {
    const ConfigNode& item = list.items()[i];
    const std::string place = path + "." + std::to_string(i);
    ScheduleLeg leg;
    const int errors = diagnostics.error_count();
    read_params(
        item, place, [&](ParamVisitor& visit) { describe(visit, leg); }, diagnostics);
    const bool last = i + 1 == list.items().size();
    if (diagnostics.error_count() == errors &&
        ((!legs.empty() && leg.start <= legs.back().start) || (leg.end == 0 ? !last : leg.end < leg.start)))
      diagnostics.error("config.schedule.legs", item.location().text(),
                        place + ": the leg does not follow on the one before",
                        "legs start one after the other, and only the last may have no end yet");
    legs.push_back(leg);
  }
  return legs;
}

ConfigNode legs_config(const std::vector<ScheduleLeg>& legs) {
  std::vector<ConfigNode> items;
  for (ScheduleLeg leg : legs) items.push_back(params_to_config([&](ParamVisitor& visit) { describe(visit, leg); }));
  return ConfigNode::make_list(std::move(items), {});
}

std::int64_t last_step(const RunConfig& config) {
  const std::vector<ScheduleLeg>& legs = config.schedule.legs;
  return legs.empty() ? config.train.steps : legs.back().end;
}

double end_s(const RunConfig& config) {
  const std::vector<ScheduleLeg>& legs = config.schedule.legs;
  return legs.empty() ? config.train.time_s : legs.back().until_s;
}

std::string length_text(const RunConfig& config) {
  const std::int64_t end = last_step(config);
  return end > 0 ? fmt::format("{} steps", end) : fmt::format("{:.6g} s of training", end_s(config));
}

void ask(RunConfig& config, const AskedLength& asked) {
  config.train.steps = asked.steps;
  config.train.time_s = asked.seconds;
  config.schedule.hold_steps = 0;
  config.schedule.decay_steps = asked.steps;
  config.schedule.legs.clear();
}

void ask_more(RunConfig& config, const AskedLength& asked, std::int64_t step, double train_s) {
  if (step == 0) return ask(config, asked);
  ScheduleParams& schedule = config.schedule;
  std::erase_if(schedule.legs, [&](const ScheduleLeg& leg) { return leg.start >= step; });
  const double until_s = asked.seconds > 0 ? train_s + asked.seconds : 0;
  if (last_step(config) == 0) {  // it still holds its rate, and goes on doing so
    if (schedule.legs.empty()) {
      config.train.time_s = until_s;
    } else {
      schedule.legs.back().until_s = until_s;
    }
    if (asked.steps > 0) settle(config, step, step + asked.steps);
    return;
  }
  ScheduleLeg leg;
  leg.start = leg.hold_until = step;
  leg.rate = schedule_factor(schedule, step);
  if (schedule.kind != ScheduleKind::constant) leg.rate = std::max(leg.rate, kFurtherRate);
  if (asked.steps > 0) leg.end = step + asked.steps;
  leg.until_s = until_s;
  schedule.legs.push_back(leg);
}

std::string resolve_length(RunConfig& config, Device device) {
  ScheduleParams& schedule = config.schedule;
  std::string text;
  if (last_step(config) == 0 && end_s(config) <= 0) {
    const bool cpu = device == Device::cpu;
    config.train.steps = cpu ? kStepsOnCpu : kStepsOnGpu;
    text = fmt::format("{} steps, the length for a {}; train.time_s or train.steps asks for another",
                       config.train.steps, cpu ? "CPU" : "GPU");
  }
  if (config.train.steps > 0 && schedule.decay_steps == 0) schedule.decay_steps = config.train.steps;
  if (config.train.steps == 0) schedule.hold_steps = schedule.decay_steps = 0;
  return text;
}

void settle(RunConfig& config, std::int64_t step, std::int64_t end) {
  ScheduleParams& schedule = config.schedule;
  if (last_step(config) == 0 && schedule.legs.empty()) {
    config.train.steps = schedule.decay_steps = end;
    schedule.hold_steps = step;
  } else if (last_step(config) == 0) {
    schedule.legs.back().hold_until = step;
    schedule.legs.back().end = end;
  } else {
    schedule.legs.push_back({step, schedule_factor(schedule, step), step, end, end_s(config)});
  }
}

void check_length(const RunConfig& config, Diagnostics& diagnostics) {
  const std::int64_t end = last_step(config);
  if (end > 0 && config.schedule.warmup_steps >= end) {
    diagnostics.error("config.schedule.warmup", "train.schedule.warmup_steps",
                      fmt::format("a warm-up of {} steps does not end in a run of {}: the learning rate never reaches "
                                  "its value",
                                  config.schedule.warmup_steps, end),
                      "warm up for fewer steps, or train longer");
  }
  for (const LossEntry& entry : config.losses) {
    const double share = entry.loss->rule().from_step;
    const bool never = end > 0 ? step_of_share(share, config.train.steps, config.schedule) >= end : share >= 1;
    if (!never) continue;
    diagnostics.error("config.loss.never", entry.where,
                      fmt::format("losses: the term '{}' never works: its from_step {:.6g} is the end of the run{}",
                                  entry.type, share, end > 0 ? fmt::format(" of {} steps", end) : ""),
                      "let it begin earlier, or take it out of the list");
  }
}

}  // namespace semfield
