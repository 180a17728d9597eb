// Words, numbers and characters of text files.
#pragma once

#include <charconv>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <system_error>
#include <vector>

namespace semfield {

/// '0' to '9', in every locale.
constexpr bool is_digit(char c) { return c >= '0' && c <= '9'; }
/// A digit or a letter of ASCII, in every locale.
constexpr bool is_alnum(char c) { return is_digit(c) || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z'); }
/// The text with small letters instead of ASCII's capitals.
std::string lower_case(std::string text);

/// Words between blanks, tabs, line ends; views into `text`.
std::vector<std::string_view> words_of(std::string_view text);
/// The same as texts of their own.
std::vector<std::string> word_list(std::string_view text);

/// What stands between the separators, empty parts too; views into `text`.
std::vector<std::string_view> parts_of(std::string_view text, char separator);

/// The next line without its end, and `text` shortened by it; a carriage return before the end is dropped too. False
/// when `text` is empty.
bool next_line(std::string_view& text, std::string_view& line);

/// The whole text as a number of this type, by std::from_chars: without blanks and plus. None for anything else, and
/// for what the type cannot hold.
template <class T>
std::optional<T> to_number(std::string_view text) {
  T value{};
  const auto [end, status] = std::from_chars(text.data(), text.data() + text.size(), value);
  return status == std::errc{} && end == text.data() + text.size() ? std::optional(value) : std::nullopt;
}

/// The whole word as a number; "nan" and "-inf" are numbers too. False (out unchanged) for anything else.
bool parse_number(std::string_view word, double& out);

/// The words of a text as numbers, behind those in `out`. What is left from the first word that is none; "" where all
/// are.
std::string_view parse_numbers(std::string_view text, std::vector<double>& out);

/// Bytes of the character that begins at `i`, by well-formed UTF-8 [Unicode, table 3-7]; 0 where none does.
std::size_t utf8_length(std::string_view text, std::size_t i);

/// Whether the byte goes on a character of UTF-8 that an earlier one begins.
constexpr bool continues_utf8(char c) { return (static_cast<unsigned char>(c) & 0xC0u) == 0x80u; }

/// The character that the text begins with, whose bytes utf8_length counted.
std::uint32_t character_at(std::string_view text, std::size_t length);

/// True for a text of one line in well-formed UTF-8 without control characters: what names of files and classes are,
/// which go into messages, tables and names of other files.
bool is_line_of_text(std::string_view text);

/// The text as one word of a POSIX shell: as it stands where it can, else in single quotes. For commands that a message
/// names, so that they work as written.
std::string shell_word(std::string_view text);

/// A parser's message of nlohmann-json without its number: "parse error at line 1, column 5: ...".
std::string json_cause(const std::string& message);

// Names that were meant: known names near a misspelt one.

/// As did_you_mean (core/error.h), by edit distance alone: for names that share their parts.
std::string closest_spelling(std::string_view word, const std::vector<std::string>& known);

// Names that look alike: one character, or a letter and its marks.

/// The text with its composed characters taken apart [Unicode, NFD]: two names that look the same, of which macOS wrote
/// one and another system the other, are equal so. Of Latin, today's Greek, Cyrillic, kana and Hangul; marks keep the
/// order in which they stand, and bytes that are no UTF-8 stay as they are.
std::string decomposed(std::string_view text);

}  // namespace semfield
