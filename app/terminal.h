// What people see on a terminal: one live line that is overwritten, and sentences above it, both within its width.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "core/non_copyable.h"

namespace semfield::app {

/// A part of a live line, with what parts it from the one before. Where the line is too long, the part of the highest
/// rank goes first, of equal ones the last.
struct LinePart {
  int rank = 0;
  std::string text;
};

/// The parts that fit into `columns`; of the last one what fits.
std::string fitted(std::vector<LinePart> parts, int columns);
/// `text` with line ends in the place of blanks, so that no line is longer than `columns` where words, and lists with
/// commas, permit. What stands between backticks is a command that people copy, and stays whole. `hanging`: where a
/// line has a column of names, or only one word in front of its figures, what is broken off stands below what follows
/// on the name.
std::string wrapped(const std::string& text, int columns, bool hanging = false);
/// `text` in colours: "warning" and "error" at the start of a line, commands between backticks or behind "$ ", and
/// faint, codes of findings and comments.
std::string painted(std::string text);
/// Whether a stream shows them: it is a terminal with colours, and NO_COLOR is not set.
bool has_colors(int stream);

/// Of stderr, or what COLUMNS says; 80 where nothing is known.
int terminal_columns();
/// Puts a line, which is shorter than the terminal is wide, in the place of the live one.
void show_live(const std::string& line);
void clear_live();
/// A text of lines on stderr: the live line is cleared before it, and on a terminal it is wrapped and in colours.
void say(const std::string& text, bool terminal);

// A line that says how far long work is: overwritten on a terminal, every two seconds a new one elsewhere.

/// "4:05", "1:02:05".
std::string clock_text(double seconds);
/// "0.1234"; `none` without a value.
std::string figure_text(const std::optional<double>& value, const char* none = "-");

class ProgressLine : NonCopyable {
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

/// Scenes that are opened under context.work show a ProgressLine. `context` outlives them.
void show_load_progress(AppContext& context);

// What a verb says that people do next: commands that work as they stand, in the order printed.

struct NextStep {
  std::string words;  ///< behind the program's name
  std::string what;   ///< what it does, for people
};

/// On stderr, a line each, or two where a terminal is narrow. Nothing for --quiet, --json, and for verbs that `semfield
/// demo` runs.
void print_next(const AppContext& context, const std::vector<NextStep>& steps, const std::string& program = "semfield");

/// For verbs that start others and say what is next themselves: print_next() of a child says nothing.
void leave_next_out_of_children(bool left_out);

}  // namespace semfield::app
