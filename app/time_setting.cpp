#include "app/time_setting.h"

#include <cmath>
#include <exception>

#include "config/params_read.h"
#include "core/error.h"

namespace semfield::app {

namespace {

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
  if (end == 0 || factor < 0 || !(value > 0) || !std::isfinite(value)) {
    throw Error(ErrorKind::usage, "--time " + text + ": expected a positive time such as 90s, 5m or 1h");
  }
  return value * factor;
}

}  // namespace

std::string time_setting(const std::string& text) {
  return "--time train.time_limit_s=" + shortest_number(parse_seconds(text));
}

}  // namespace semfield::app
