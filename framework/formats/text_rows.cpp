#include "formats/text_rows.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <optional>

#include "core/files.h"
#include "core/text.h"
#include "core/workspace.h"

namespace semfield {

namespace {

constexpr std::string_view kBlanks = " \t\r";

std::string trimmed(std::string_view text) {
  const std::size_t first = text.find_first_not_of(kBlanks);
  if (first == std::string_view::npos) return {};
  return std::string(text.substr(first, text.find_last_not_of(kBlanks) - first + 1));
}

// `at` stands behind the opening quote; moves it behind the closing one.
std::string quoted_field(std::string_view line, std::size_t& at, const std::string& place) {
  std::string out;
  for (; at < line.size(); ++at) {
    if (line[at] == '"') {
      ++at;
      if (at >= line.size() || line[at] != '"') return out;
    }
    out += line[at];
  }
  throw Error(ErrorKind::data, "files.rows.quote", place + ": a quote is not closed",
              "end the field with a double quote");
}

std::vector<std::string> fields_of(std::string_view line, char separator, const std::string& place) {
  std::vector<std::string> out;
  for (std::size_t at = 0;;) {
    const std::size_t first = std::min(line.find_first_not_of(' ', at), line.size());
    if ((separator == ',' || separator == ';') && first < line.size() && line[first] == '"') {
      at = first + 1;
      out.push_back(quoted_field(line, at, place));
      const std::size_t end = std::min(line.find(separator, at), line.size());
      if (const std::string rest = trimmed(line.substr(at, end - at)); !rest.empty())
        throw Error(ErrorKind::data, "files.rows.quote",
                    place + ": '" + rest.substr(0, 40) + "' follows a quoted field",
                    "write two double quotes for one inside, and nothing behind the last");
      at = end == line.size() ? std::string_view::npos : end;
    } else {
      const std::size_t end = line.find(separator, at);
      out.push_back(trimmed(line.substr(at, end == std::string_view::npos ? end : end - at)));
      at = end;
    }
    if (at == std::string_view::npos) return out;
    ++at;
  }
}

// A spreadsheet takes such a text for a formula, also in quotes.
bool is_formula(std::string_view text) {
  const std::size_t first = text.find_first_not_of('\'');
  return first != std::string_view::npos && std::string_view("=+-@\t\r").find(text[first]) != std::string_view::npos;
}

// What csv_field was given, of a field without its quotes.
std::string csv_value(std::string field) {
  if (field.starts_with('\'') && is_formula(field)) field.erase(0, 1);
  return field;
}

}  // namespace

std::vector<TextRow> read_text_rows(const std::string& path, char separator) {
  const std::string text = read_text_file(path, std::size_t{64} << 20);
  std::vector<TextRow> rows;
  std::size_t at = 0;
  if (text.rfind("\xEF\xBB\xBF", 0) == 0) at = 3;
  for (int number = 1; at < text.size(); ++number) {
    const std::size_t end = std::min(text.find('\n', at), text.size());
    const std::string_view line = std::string_view(text).substr(at, end - at);
    at = end + 1;
    const std::string shown = trimmed(line);
    if (shown.empty() || shown[0] == '#') continue;
    TextRow row{path + ":" + std::to_string(number), {}};
    row.fields = fields_of(line, separator, row.place);
    rows.push_back(std::move(row));
  }
  return rows;
}

namespace {

// As columns are named in ColumnNames.
std::string column_name(std::string_view text) {
  std::string out = trimmed(text);
  for (char& c : out) c = c == ' ' || c == '-' ? '_' : static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return out;
}

char separator_of(const std::string& path) {
  std::string start = read_file_start(path, 65536);
  for (std::string_view text = start, line; next_line(text, line);) {
    if (trimmed(line).empty() || line[0] == '#') continue;
    for (const char separator : {',', ';', '\t'})
      if (line.find(separator) != std::string_view::npos) return separator;
    break;
  }
  return ',';
}

// Where the file has each column, if `row` names them.
std::optional<std::vector<std::size_t>> columns_named(const TextRow& row, const std::vector<ColumnNames>& columns) {
  std::vector<std::string> names;
  for (const std::string& field : row.fields) {
    double number = 0;
    if (parse_real(field, number)) return std::nullopt;
    names.push_back(column_name(field));
  }
  std::vector<std::size_t> out(columns.size(), std::string::npos);
  bool any = false;
  for (std::size_t c = 0; c < columns.size(); ++c) {
    for (const std::string_view name : columns[c]) {
      const auto found = std::find(names.begin(), names.end(), name);
      if (found == names.end()) continue;
      if (std::find(found + 1, names.end(), name) != names.end())
        throw Error(ErrorKind::data, "files.rows.column_twice",
                    row.place + ": the column '" + std::string(name) + "' is named twice", "keep one of them");
      out[c] = static_cast<std::size_t>(found - names.begin());
      any = true;
      break;
    }
  }
  return any ? std::optional(out) : std::nullopt;
}

}  // namespace

TextTable read_text_table(const std::string& path, const std::vector<ColumnNames>& columns) {
  TextTable table{read_text_rows(path, separator_of(path)), "", std::vector<char>(columns.size())};
  if (table.rows.empty()) return table;
  const std::optional<std::vector<std::size_t>> named = columns_named(table.rows[0], columns);
  const std::size_t most = named ? table.rows[0].fields.size() : columns.size();
  if (named) {
    table.header = table.rows[0].place;
    table.rows.erase(table.rows.begin());
  }
  for (TextRow& row : table.rows) {
    if (row.fields.size() > most)
      throw Error(ErrorKind::data, "files.rows.columns",
                  row.place + ": " + std::to_string(row.fields.size()) + " columns, " +
                      (named ? "the first line names " + std::to_string(most)
                             : "at most " + std::to_string(most) + " are read"),
                  "put a field that holds the separator in double quotes, or name every column in the header");
    std::vector<std::string> fields(columns.size());
    for (std::size_t c = 0; c < columns.size(); ++c) {
      const std::size_t at = named ? (*named)[c] : c;
      if (at >= row.fields.size()) continue;
      fields[c] = csv_value(std::move(row.fields[at]));
      table.has[c] = 1;
    }
    row.fields = std::move(fields);
  }
  for (std::size_t c = 0; named && c < columns.size(); ++c) table.has[c] = (*named)[c] != std::string::npos;
  return table;
}

std::string csv_field(std::string_view value) {
  const std::string text = (is_formula(value) ? "'" : "") + std::string(value);
  const bool plain = text.find_first_of(",\"\n\r") == std::string_view::npos && trimmed(text) == text;
  if (plain) return text;
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"') out += '"';
    out += c;
  }
  return out + "\"";
}

bool parse_whole(std::string_view text, std::int64_t& out) {
  const auto read = to_number<std::int64_t>(text);
  out = read.value_or(out);
  return read.has_value();
}
bool parse_real(std::string_view text, double& out) {
  const auto read = to_number<double>(text);
  out = read.value_or(out);
  return read && std::isfinite(*read);
}

void describe(ParamVisitor& visit, InputLimits& p) {
  SEMFIELD_PARAM(visit, p, image_axis_px, "pixels along an axis of an image", {1, 1 << 20});
  SEMFIELD_PARAM(visit, p, image_pixels, "pixels of an image", {1, 1e12});
  SEMFIELD_PARAM(visit, p, image_channels, "channels of an image", {1, 1024});
  SEMFIELD_PARAM(visit, p, image_bytes, "bytes of an image once decoded", {1, 1e13});
  SEMFIELD_PARAM(visit, p, pose_file_bytes, "bytes of a file of poses, or of an index of frames", {1, 1e12});
  SEMFIELD_PARAM(visit, p, mesh_corners, "corners of all triangles of a mesh", {3, 2147483647});
  SEMFIELD_PARAM(visit, p, classes, "classes of a table, ignored ones not counted", {1, 32767});
  SEMFIELD_PARAM(visit, p, frames, "frames of a scene", {1, 1e8});
}

const InputLimits& input_limits() {
  static const InputLimits defaults;
  const InputLimits* own = work_settings().limits;
  return own != nullptr ? *own : defaults;
}

void check_input_limit(std::int64_t count, std::int64_t limit, const std::string& what, const std::string& noun,
                       const std::string& key) {
  if (count <= limit) return;
  throw Error(ErrorKind::data, "files.input.limit",
              what + std::to_string(count) + " " + noun + "; at most " + std::to_string(limit) + " are read",
              "check that it is the right file, or raise limits." + key + " in the configuration");
}

void check_image_limits(std::int64_t width, std::int64_t height, std::int64_t channels, std::int64_t bytes_a_value) {
  const std::string size = "image of " + std::to_string(width) + " x " + std::to_string(height) + " pixels: ";
  if (width < 1 || height < 1)
    throw Error(ErrorKind::data, "files.image.damaged",
                "image has no pixels (" + std::to_string(width) + " x " + std::to_string(height) + ")",
                "copy or export the file again");
  const InputLimits& most = input_limits();
  check_input_limit(std::max(width, height), most.image_axis_px, size, "pixels along an axis", "image_axis_px");
  check_input_limit(width * height, most.image_pixels, size, "pixels", "image_pixels");
  check_input_limit(channels, most.image_channels, size, "channels", "image_channels");
  check_input_limit(width * height * channels * bytes_a_value, most.image_bytes, size, "bytes once decoded",
                    "image_bytes");
}

std::string read_pose_file(const std::string& path) {
  const auto most = static_cast<std::size_t>(input_limits().pose_file_bytes);
  try {
    return read_text_file(path, most);
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::data) throw;
    throw Error(e.kind(), e.code(), e.message(), e.remedy() + ", or raise limits.pose_file_bytes in the configuration");
  }
}

}  // namespace semfield
