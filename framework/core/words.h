// Words and numbers of text files whose lines are separated by blanks.
#pragma once

#include <string_view>
#include <vector>

namespace semfield {

/// Words between blanks, tabs, line ends; views into `text`.
std::vector<std::string_view> words_of(std::string_view text);

/// The next line without its end, and `text` shortened by it; a carriage return before the end is dropped too. False
/// when `text` is empty.
bool next_line(std::string_view& text, std::string_view& line);

/// The whole word as a number; "nan" and "-inf" are numbers too. False (out unchanged) for anything else.
bool parse_number(std::string_view word, double& out);

}  // namespace semfield
