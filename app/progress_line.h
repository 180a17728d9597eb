// A line that says how far long work is: overwritten on a terminal, every two seconds a new one elsewhere.
#pragma once

#include <functional>
#include <string>

#include "app/app_context.h"
#include "app/terminal.h"

namespace semfield::app {

/// "4:05", "1:02:05".
std::string clock_text(double seconds);

class ProgressLine {
 public:
  /// What a test replaces.
  struct Outside {
    std::function<double()> now_s;                  ///< a clock that never runs back
    std::function<void(const std::string&)> write;  ///< of a terminal's live line, "" clears it; elsewhere whole lines
    std::function<int()> columns = terminal_columns;
  };

  /// `done_what`: "rendered", followed by "3/40 frames, 0:12 left". Quiet contexts get nothing.
  ProgressLine(const AppContext& context, std::string done_what, std::string unit = "frames");
  ProgressLine(const AppContext& context, std::string done_what, std::string unit, Outside outside);
  ProgressLine(const ProgressLine&) = delete;
  ProgressLine& operator=(const ProgressLine&) = delete;
  /// A terminal's line is cleared: what comes next says the result.
  ~ProgressLine() { end(); }

  /// `done` may hold part of a unit. Work that ends within two seconds leaves no line where lines stay.
  void show(double done, double total);
  /// What is done next, and of what; its time counts from now.
  void restart(std::string done_what, std::string unit = "frames");

 private:
  void end();
  bool quiet_, terminal_, open_ = false;
  std::string done_what_, unit_;
  Outside outside_;
  double begin_s_, next_s_;
};

}  // namespace semfield::app
