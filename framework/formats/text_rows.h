// Tables kept as text, one row a line: CSV, TSV, and colon-separated label maps; limits of inputs; JSON.
#pragma once

#include <cstdint>
#include <set>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "config/params.h"
#include "core/error.h"

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

// How large inputs may be: what every reader asks before it takes memory on the word of a file.

/// The section `limits` of a configuration.
struct InputLimits {
  std::int64_t image_axis_px = 16384;
  std::int64_t image_pixels = std::int64_t{1} << 28;
  std::int64_t image_channels = 16;
  std::int64_t image_bytes = std::int64_t{1} << 30;  ///< of one decoded image
  std::int64_t pose_file_bytes = std::int64_t{256} << 20;
  std::int64_t mesh_corners = (std::int64_t{1} << 31) - 1;
  std::int64_t classes = 1024;
  std::int64_t frames = std::int64_t{1} << 20;
};
void describe(ParamVisitor& visit, InputLimits& limits);

/// Those of this thread's work_settings(), or else the defaults.
const InputLimits& input_limits();

/// Throws Error(data) "WHAT: COUNT NOUN; at most LIMIT are read" whose remedy names `limits.KEY`, when count is above
/// limit.
void check_input_limit(std::int64_t count, std::int64_t limit, const std::string& what, const std::string& noun,
                       const std::string& key);

/// Refuses empty images and those over the limits of axis, pixels, channels and bytes once decoded.
void check_image_limits(std::int64_t width, std::int64_t height, std::int64_t channels = 1,
                        std::int64_t bytes_a_value = 1);

/// A file of poses or an index of frames as text; Error(data) above limits.pose_file_bytes, Error(no_input) as
/// read_text_file.
std::string read_pose_file(const std::string& path);

/// Runs `body`; an Error on the way names the file: "'PATH': " stands before a message without it.
template <class Body>
auto naming(const std::string& path, const Body& body) {
  try {
    return body();
  } catch (const Error& e) {
    if (e.message().find(path) != std::string::npos) throw;
    throw Error(e.kind(), e.code(), "'" + path + "': " + e.message(), e.remedy());
  }
}

// JSON taken as it is: of a key that a map has twice, a parser would keep the last without a word; and what a type
// would cut, or turn round, is refused.

/// Gets the parsed text; `twice` gets a key that stands twice in one map, the first of several. Throws what Json does,
/// and what `at_depth(depth)` does.
template <class Json, class AtDepth>
Json parse_json(std::string_view text, std::string& twice, const AtDepth& at_depth) {
  using Event = typename Json::parse_event_t;
  std::vector<std::set<std::string>> keys;  // of the maps that are open
  const typename Json::parser_callback_t watch = [&](int depth, Event event, Json& parsed) {
    at_depth(depth);
    if (event == Event::object_start) keys.emplace_back();
    if (event == Event::object_end && !keys.empty()) keys.pop_back();
    if (event != Event::key || keys.empty()) return true;
    const auto key = parsed.template get<std::string>();
    if (!keys.back().insert(key).second && twice.empty()) twice = key;
    return true;
  };
  return Json::parse(text, watch);
}

/// Numbers are counts and sizes, which are not negative. `Json` is one of nlohmann's. Throws std::out_of_range naming
/// `key` and the value, and what Json throws for another kind of value.
template <class Json, class T>
void read_json_value(const Json& map, const char* key, T& into) {
  const Json& from = map.at(key);
  bool fits = !std::is_integral_v<T> || std::is_same_v<T, bool> || from.is_number_integer();
  if (fits) {
    from.get_to(into);
    fits = Json(into) == from;
  }
  if constexpr (std::is_arithmetic_v<T> && std::is_signed_v<T>) fits = fits && into >= 0;
  if (!fits) throw std::out_of_range(std::string(key) + " is " + from.dump());
}

}  // namespace semfield
