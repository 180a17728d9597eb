#include "formats/text_rows.h"

#include <algorithm>
#include <charconv>
#include <cmath>

#include "core/error.h"
#include "system/files.h"

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
    if (separator == ',' && first < line.size() && line[first] == '"') {
      at = first + 1;
      out.push_back(quoted_field(line, at, place));
      at = line.find(separator, at);
    } else {
      const std::size_t end = line.find(separator, at);
      out.push_back(trimmed(line.substr(at, end == std::string_view::npos ? end : end - at)));
      at = end;
    }
    if (at == std::string_view::npos) return out;
    ++at;
  }
}

template <class T>
bool parse(std::string_view text, T& out) {
  const auto [end, status] = std::from_chars(text.data(), text.data() + text.size(), out);
  return !text.empty() && status == std::errc{} && end == text.data() + text.size();
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

std::string csv_field(std::string_view text) {
  const bool plain = text.find_first_of(",\"\n\r") == std::string_view::npos && trimmed(text) == text;
  if (plain) return std::string(text);
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"') out += '"';
    out += c;
  }
  return out + "\"";
}

std::string csv_value(std::string_view text, const std::string& place) {
  const std::string field = trimmed(text);
  if (!field.starts_with('"')) return field;
  std::size_t at = 1;
  std::string value = quoted_field(field, at, place);
  if (at != field.size())
    throw Error(ErrorKind::data, "files.rows.quote", place + ": '" + field.substr(at, 40) + "' follows a quoted field",
                "write two double quotes for one inside, and nothing behind the last");
  return value;
}

bool parse_whole(std::string_view text, std::int64_t& out) { return parse(text, out); }
bool parse_real(std::string_view text, double& out) { return parse(text, out) && std::isfinite(out); }

}  // namespace semfield
