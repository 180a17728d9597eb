// Words, numbers and characters of text files.
#pragma once

#include <cstddef>
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

/// Bytes of the character that begins at `i`, by well-formed UTF-8 [Unicode, table 3-7]; 0 where none does.
std::size_t utf8_length(std::string_view text, std::size_t i);

}  // namespace semfield
