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
/// ',' or ';' as separator a field may stand in double quotes, a doubled quote inside being one quote. Throws
/// Error(data) for a quote that is not closed or that is followed by anything, Error(no_input) as read_text_file does.
std::vector<TextRow> read_text_rows(const std::string& path, char separator);

/// The names that a column of a table goes by, the first of them its own: small letters, '_' for blanks.
using ColumnNames = std::vector<std::string_view>;

/// A CSV table whose first row may name its columns. Whatever their order in the file, the fields of a row stand in the
/// order that was asked for, "" where the file has none.
struct TextTable {
  std::vector<TextRow> rows;  ///< without the names
  std::string header;         ///< place of the row of names, "" without one
  std::vector<char> has;      ///< whether the file has the column; without names, whether any row reaches it
};

/// Reads with the separator that the first row has: ',', else ';' or a tab. A row without a number in which one of the
/// columns stands under any of its names, in any case, gives the columns; others than those asked for are passed over.
/// Without such a row the columns stand in the order of `columns`. Apostrophes that csv_field put before formulas are
/// taken off. Throws as read_text_rows, and Error(data) for a row
/// of more fields than there are columns and for a column that is named twice.
TextTable read_text_table(const std::string& path, const std::vector<ColumnNames>& columns);

/// A value of a CSV line, in double quotes where it must be [RFC4180], or where blanks at its ends would be lost. A
/// text that a spreadsheet would take for a formula, as it begins with one of = + - @, gets an apostrophe before it.
std::string csv_field(std::string_view value);

/// Whole text as a number; false for anything else.
bool parse_whole(std::string_view text, std::int64_t& out);
bool parse_real(std::string_view text, double& out);

}  // namespace semfield
