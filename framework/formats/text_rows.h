// Tables kept as text, one row a line: CSV, TSV, and colon-separated label maps.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace semfield {

struct TextRow {
  std::string place;                ///< "file:line", for messages
  std::vector<std::string> fields;  ///< without surrounding blanks
};

/// Rows of a file of at most 64 MiB; empty lines and lines that begin with '#' are left out, CR LF counts as LF. With
/// ',' as separator a field may stand in double quotes, a doubled quote inside being one quote. Throws Error(data) for
/// a quote that is not closed, Error(no_input) as read_text_file does.
std::vector<TextRow> read_text_rows(const std::string& path, char separator);

/// A value of a CSV line, in double quotes where it must be [RFC4180], or where blanks at its ends would be lost.
std::string csv_field(std::string_view text);
/// The value of the one field that `text` holds: csv_field() read back. Without quotes it is the text itself, commas
/// included. Throws Error(data) at `place` for a quote that is not closed, or that is followed by anything.
std::string csv_value(std::string_view text, const std::string& place);

/// Whole text as a number; false for anything else.
bool parse_whole(std::string_view text, std::int64_t& out);
bool parse_real(std::string_view text, double& out);

}  // namespace semfield
