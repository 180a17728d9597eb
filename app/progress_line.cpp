#include "app/progress_line.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <climits>
#include <cmath>

namespace semfield::app {

namespace {

constexpr double kOverwriteEvery_s = 0.1, kLineEvery_s = 2;

double steady_seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

ProgressLine::Outside stderr_of(bool terminal) {
  if (!terminal) return {steady_seconds, [](const std::string& line) { say(line, false); }};
  return {steady_seconds, [](const std::string& line) { line.empty() ? clear_live() : show_live(line); }};
}

}  // namespace

std::string clock_text(double seconds) {
  const auto s = static_cast<long>(std::lround(std::max(seconds, 0.0)));
  return s >= 3600 ? fmt::format("{}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
                   : fmt::format("{}:{:02}", s / 60, s % 60);
}

ProgressLine::ProgressLine(const AppContext& context, std::string done_what, std::string unit)
    : ProgressLine(context, std::move(done_what), std::move(unit), stderr_of(context.terminal)) {}

ProgressLine::ProgressLine(const AppContext& context, std::string done_what, std::string unit, Outside outside)
    : quiet_(context.quiet),
      terminal_(context.terminal),
      done_what_(std::move(done_what)),
      unit_(std::move(unit)),
      outside_(std::move(outside)),
      begin_s_(outside_.now_s()),
      next_s_(begin_s_ + (terminal_ ? 0 : kLineEvery_s)) {}

void ProgressLine::show(double done, double total) {
  const double now_s = outside_.now_s();
  if (quiet_ || (now_s < next_s_ && !(terminal_ && done >= total))) return;
  next_s_ = now_s + (terminal_ ? kOverwriteEvery_s : kLineEvery_s);
  std::vector<LinePart> parts{{0, fmt::format("{} {:.0f}/{:.0f}", done_what_, std::floor(done), total)},
                              {2, " " + unit_}};
  if (done > 0 && done < total)
    parts.push_back({1, fmt::format(", {} left", clock_text((now_s - begin_s_) / done * (total - done)))});
  // The last column stays free: some terminals go to the next line with it.
  outside_.write(fitted(std::move(parts), terminal_ ? outside_.columns() - 1 : INT_MAX));
  open_ = terminal_;
}

void ProgressLine::restart(std::string done_what, std::string unit) {
  end();
  done_what_ = std::move(done_what);
  unit_ = std::move(unit);
  begin_s_ = outside_.now_s();
  next_s_ = begin_s_ + (terminal_ ? 0 : kLineEvery_s);
}

void ProgressLine::end() {
  if (open_) outside_.write("");
  open_ = false;
}

}  // namespace semfield::app
