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

/// Whole text as a number; false for anything else.
bool parse_whole(std::string_view text, std::int64_t& out);
bool parse_real(std::string_view text, double& out);

}  // namespace semfield
