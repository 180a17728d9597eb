#include "app/length_words.h"

#include <cmath>
#include <exception>

#include "core/error.h"

namespace semfield::app {

namespace {

constexpr double kMostSteps = 1e9, kMost_s = 1e8;

double parse_seconds(const std::string& text) {
  std::size_t end = 0;
  double value = 0;
  try {
    value = std::stod(text, &end);
  } catch (const std::exception&) {
    end = 0;
  }
  const std::string unit = text.substr(end);
  const double factor = unit.empty() || unit == "s" ? 1 : unit == "m" ? 60 : unit == "h" ? 3600 : -1;
  if (end == 0 || factor < 0 || !(value > 0) || !(value * factor <= kMost_s)) {
    throw Error(ErrorKind::usage, "usage.value.time",
                "--time " + text + ": expected a positive time such as 90s, 5m or 1h");
  }
  return value * factor;
}

}  // namespace

void declare_length(VerbWords& verb, LengthWords& words) {
  verb.value("--time TIME", words.time,
             "train for this long, 90s, 5m or 1h: steps and schedule are settled by the rate of the first steps");
  verb.value_in("--steps N", words.steps, 1, kMostSteps,
                "train this many steps, with the schedule of that length (default: train.steps)");
  verb.excludes("--steps", "--time");
}

AskedLength asked_length(const LengthWords& words) {
  return {words.steps.value_or(0), words.time.empty() ? 0 : parse_seconds(words.time)};
}

}  // namespace semfield::app
