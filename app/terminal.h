// What people see on a terminal: one live line that is overwritten, and sentences above it, both within its width.
#pragma once

#include <string>
#include <vector>

namespace semfield::app {

/// A part of a live line, with what parts it from the one before. Where the line is too long, the part of the highest
/// rank goes first, of equal ones the last.
struct LinePart {
  int rank = 0;
  std::string text;
};

/// The parts that fit into `columns`; of the last one what fits.
std::string fitted(std::vector<LinePart> parts, int columns);
/// `text` with line ends in the place of blanks, so that no line is longer than `columns` where words permit. What
/// stands between backticks is a command that people copy, and stays whole.
std::string wrapped(const std::string& text, int columns);

/// Of stderr, or what COLUMNS says; 80 where nothing is known.
int terminal_columns();
/// Puts a line, which is shorter than the terminal is wide, in the place of the live one.
void show_live(const std::string& line);
void clear_live();
/// A text of lines on stderr: the live line is cleared before it, and on a terminal it is wrapped.
void say(const std::string& text, bool terminal);

}  // namespace semfield::app
