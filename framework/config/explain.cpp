// Trees as text: block maps and lists, lists of scalars in one line; with the place of every value; and how two differ.
// Parameters as trees and rows of text.
#include "config/explain.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <string_view>
#include <utility>

#include "config/config_words.h"
#include "core/check.h"
#include "core/text.h"

namespace semfield {
namespace {

bool is_null_word(std::string_view text) {
  return text.empty() || text == "~" || lower_case(std::string(text)) == "null";
}

// Unquoted and unchanged in block and flow context alike; narrower than YAML's own rule, so that it needs no context.
bool survives_unquoted(std::string_view text) {
  constexpr std::string_view kInside = "_./+-%()=@^~ ";
  if (text.empty()) return false;
  const char first = text.front();
  const bool sign = first == '-' || first == '+';
  if (sign ? text.size() < 2 || !(is_alnum(text[1]) || text[1] == '.')
           : !(is_alnum(first) || first == '_' || first == '.' || first == '/')) {
    return false;
  }
  if (text.back() == ' ' || text.substr(0, 3) == "...") return false;
  return std::all_of(text.begin(), text.end(),
                     [&](char c) { return is_alnum(c) || kInside.find(c) != std::string_view::npos; });
}

// What a reader would not see, or take for the end of a line: controls, separators, the byte order mark.
bool is_unseen(std::uint32_t c) {
  return c < 0x20 || (c >= 0x7F && c < 0xA0) || c == 0x2028 || c == 0x2029 || c == 0xFEFF;
}

std::string in_quotes(std::string_view text) {
  std::string out = "\"";
  for (std::size_t i = 0, length = 0; i < text.size(); i += length) {
    const std::size_t whole = utf8_length(text, i);
    length = std::max<std::size_t>(whole, 1);
    const std::uint32_t c = whole > 0 ? character_at(text.substr(i), whole) : U'?';  // what is no UTF-8 stays as it is
    if (c == '\n' || c == '\t') {
      out += c == '\n' ? "\\n" : "\\t";
    } else if (is_unseen(c)) {
      out += c < 0x100 ? fmt::format("\\x{:02x}", c) : fmt::format("\\u{:04x}", c);
    } else {
      if (c == '"' || c == '\\') out += '\\';
      out += text.substr(i, length);
    }
  }
  return out + "\"";
}

std::string key_text(const std::string& key) {
  return survives_unquoted(key) && !is_null_word(key) ? key : in_quotes(key);
}

std::string scalar_text(const ConfigNode& node) {
  if (node.is_null()) return "null";
  return node.quoted() ? in_quotes(node.text()) : key_text(node.text());
}

bool is_leaf(const ConfigNode& node) { return node.is_scalar() || node.is_null(); }

// What stands in one line: scalars, empty collections, lists of scalars.
bool fits_line(const ConfigNode& node) {
  if (is_leaf(node)) return true;
  if (node.is_map()) return node.entries().empty();
  return std::all_of(node.items().begin(), node.items().end(), is_leaf);
}

// One line of written YAML and the node whose value stands on it (null: a bare key or dash).
struct Line {
  std::string text;
  const ConfigNode* node = nullptr;
};

// `lead` stands before the first line ("  - "), `indent` before each further one.
void write_block(const ConfigNode& node, const std::string& lead, const std::string& indent, std::vector<Line>& lines) {
  if (fits_line(node)) {
    lines.push_back({lead + write_config_inline(node), &node});
    return;
  }
  std::string before = lead;
  for (const ConfigNode::Entry& entry : node.entries()) {
    const std::string head = before + key_text(entry.first) + ":";
    const bool one_line = fits_line(entry.second);
    if (!one_line) lines.push_back({head, nullptr});
    write_block(entry.second, one_line ? head + " " : indent + "  ", indent + "  ", lines);
    before = indent;
  }
  for (const ConfigNode& item : node.items()) {
    write_block(item, before + "- ", indent + "  ", lines);
    before = indent;
  }
}

std::vector<Line> lines_of(const ConfigNode& node) {
  std::vector<Line> lines;
  write_block(node, "", "", lines);
  return lines;
}

// Lines longer than this do not push the comments of all others to the right.
constexpr std::size_t kWidestColumn = 72;

std::string place(const Location& where) { return where.file.empty() ? "default" : where.text(); }

// The place of a line's value, then of those items of a list that something else wrote.
std::string origin(const ConfigNode& node) {
  std::string text = place(node.location());
  std::vector<std::string> files{node.location().file};
  for (const ConfigNode& item : node.items()) {
    if (std::find(files.begin(), files.end(), item.location().file) != files.end()) continue;
    files.push_back(item.location().file);
    text += ", " + place(item.location());
  }
  // A line end inside an override would end the comment.
  std::replace_if(
      text.begin(), text.end(), [](char c) { return static_cast<unsigned char>(c) < 0x20; }, ' ');
  return text;
}

std::size_t width(std::string_view text) {
  return text.size() - static_cast<std::size_t>(std::count_if(text.begin(), text.end(), continues_utf8));
}

std::string below(const std::string& path, const std::string& key) { return path.empty() ? key : path + "." + key; }

bool has_parts(const ConfigNode& node) { return !node.entries().empty() || !node.items().empty(); }

// A list of plain values is one value to a reader; a list of maps is compared item by item.
bool is_list_of_parts(const ConfigNode& node) {
  return std::any_of(node.items().begin(), node.items().end(), [](const ConfigNode& item) { return item.is_map(); });
}

// Every value below a node, key by key.
template <class See>
void each_value(const ConfigNode& node, const std::string& path, const See& see) {
  if (node.is_map() && has_parts(node)) {
    for (const ConfigNode::Entry& entry : node.entries()) each_value(entry.second, below(path, entry.first), see);
  } else if (is_list_of_parts(node)) {
    for (std::size_t i = 0; i < node.items().size(); ++i)
      each_value(node.items()[i], below(path, item_key(node, i)), see);
  } else {
    see(path, node);
  }
}

// What one side alone has.
void list_absent(const ConfigNode& node, const std::string& path, bool only_left, std::vector<ConfigDifference>& out) {
  each_value(node, path, [&](const std::string& key, const ConfigNode& value) {
    const std::string text = write_config_inline(value);
    out.push_back({key, only_left ? text : kAbsent, only_left ? kAbsent : text});
  });
}

void diff(const ConfigNode& a, const ConfigNode& b, const std::string& path, std::vector<ConfigDifference>& out) {
  if (a.is_map() && b.is_map() && (has_parts(a) || has_parts(b))) {
    for (const ConfigNode::Entry& entry : a.entries()) {
      const ConfigNode* other = b.find(entry.first);
      if (other != nullptr) {
        diff(entry.second, *other, below(path, entry.first), out);
      } else {
        list_absent(entry.second, below(path, entry.first), true, out);
      }
    }
    for (const ConfigNode::Entry& entry : b.entries()) {
      if (a.find(entry.first) == nullptr) list_absent(entry.second, below(path, entry.first), false, out);
    }
    return;
  }
  if (a.is_list() && b.is_list() && (is_list_of_parts(a) || is_list_of_parts(b))) {
    const std::size_t shared = std::min(a.items().size(), b.items().size());
    for (std::size_t i = 0; i < shared; ++i) {
      const std::string key = item_key(a, i);  // the name where both have it
      diff(a.items()[i], b.items()[i], below(path, key == item_key(b, i) ? key : std::to_string(i)), out);
    }
    for (std::size_t i = shared; i < a.items().size(); ++i)
      list_absent(a.items()[i], below(path, item_key(a, i)), true, out);
    for (std::size_t i = shared; i < b.items().size(); ++i)
      list_absent(b.items()[i], below(path, item_key(b, i)), false, out);
    return;
  }
  if (equal_config(a, b)) return;
  out.push_back({path.empty() ? "(top)" : path, write_config_inline(a), write_config_inline(b)});
}

}  // namespace

bool looks_typed(std::string_view text) {
  if (is_null_word(text)) return true;
  const std::string word = lower_case(std::string(text));
  for (const std::string_view known : {"true", "false", "yes", "no", "on", "off", ".nan", ".inf", "+.inf", "-.inf"}) {
    if (word == known) return true;
  }
  // Whatever starts like a number, unless it could not even stand without quotes.
  if (!survives_unquoted(text)) return false;
  const std::size_t at = text[0] == '-' || text[0] == '+' ? 1 : 0;
  if (is_digit(text[at])) return true;
  return at + 1 < text.size() && text[at] == '.' && is_digit(text[at + 1]);
}

bool is_plain_text(std::string_view text) { return survives_unquoted(text) && !looks_typed(text); }

std::string write_config_inline(const ConfigNode& node) {
  if (is_leaf(node)) return scalar_text(node);
  std::vector<std::string> parts;
  for (const auto& [key, value] : node.entries()) parts.push_back(key_text(key) + ": " + write_config_inline(value));
  for (const ConfigNode& item : node.items()) parts.push_back(write_config_inline(item));
  return node.is_map() ? "{" + join(parts) + "}" : "[" + join(parts) + "]";
}

std::string write_config(const ConfigNode& node) {
  std::string out;
  for (const Line& line : lines_of(node)) out += line.text + "\n";
  return out;
}

std::string kind_text(const ConfigNode& node) {
  if (node.is_null()) return "nothing";
  if (node.is_scalar()) return (node.quoted() ? "text '" : "'") + node.text() + "'";
  return node.is_list() ? "a list" : "a map";
}

std::string explain_config(const ConfigNode& node) {
  const std::vector<Line> lines = lines_of(node);
  std::size_t column = 0;
  for (const Line& line : lines) {
    const std::size_t line_width = width(line.text);
    if (line.node != nullptr && line_width <= kWidestColumn) column = std::max(column, line_width);
  }
  std::string out;
  for (const Line& line : lines) {
    out += line.text;
    if (line.node != nullptr) {
      const std::size_t line_width = width(line.text);
      out += std::string(line_width < column ? column - line_width : 0, ' ') + "  # " + origin(*line.node);
    }
    out += "\n";
  }
  return out;
}

std::vector<ConfigSetting> config_settings(const ConfigNode& tree) {
  std::vector<ConfigSetting> settings;
  each_value(tree, "", [&](const std::string& key, const ConfigNode& value) {
    settings.push_back({key, write_config_inline(value), origin(value)});
  });
  return settings;
}

ConfigNode with_origins(const ConfigNode& resolved, const ConfigNode& written) {
  if (resolved.is_map() && (written.is_map() || written.is_null())) {
    std::vector<ConfigNode::Entry> entries;
    for (const ConfigNode::Entry& entry : resolved.entries()) {
      const ConfigNode* given = written.find(entry.first);
      entries.emplace_back(entry.first, given != nullptr ? with_origins(entry.second, *given) : entry.second);
    }
    for (const ConfigNode::Entry& entry : written.entries()) {
      if (resolved.find(entry.first) == nullptr) entries.push_back(entry);
    }
    return ConfigNode::make_map(std::move(entries), written.location());
  }
  if (resolved.is_list() && written.is_list() && resolved.items().size() == written.items().size()) {
    std::vector<ConfigNode> items;
    for (std::size_t i = 0; i < written.items().size(); ++i) {
      items.push_back(with_origins(resolved.items()[i], written.items()[i]));
    }
    return ConfigNode::make_list(std::move(items), written.location());
  }
  return written;
}

std::vector<ConfigDifference> config_differences(const ConfigNode& a, const ConfigNode& b) {
  std::vector<ConfigDifference> out;
  diff(a, b, "", out);
  return out;
}

// Parameters written: their values as a tree, for the resolved configuration, and as rows of text for help and
// reference page.

namespace {

ConfigNode node_of(bool value) { return ConfigNode::make_scalar(value ? "true" : "false", false, {}); }
ConfigNode node_of(std::int64_t value) { return ConfigNode::make_scalar(std::to_string(value), false, {}); }
ConfigNode node_of(double value) { return ConfigNode::make_scalar(shortest_number(value), false, {}); }
ConfigNode node_of(const std::string& value) { return ConfigNode::make_scalar(value, !is_plain_text(value), {}); }
ConfigNode node_of(const ChosenName& choice) {
  SEMFIELD_CHECK(choice.index >= 0 && static_cast<std::size_t>(choice.index) < choice.names.size(),
                 "choice outside its names");
  return node_of(std::string(choice.names[static_cast<std::size_t>(choice.index)]));
}
template <class T>
ConfigNode node_of(const std::vector<T>& values) {
  std::vector<ConfigNode> items;
  for (const T& value : values) items.push_back(node_of(value));
  return ConfigNode::make_list(std::move(items), {});
}

template <class Int>
bool is_limit_of(double value, bool upper) {
  return value == static_cast<double>(upper ? std::numeric_limits<Int>::max() : std::numeric_limits<Int>::lowest());
}

// visit_param narrows a range to what the field's type holds; such a bound says nothing to a reader.
bool is_type_limit(double value, bool upper) {
  return std::isinf(value) || is_limit_of<std::int32_t>(value, upper) || is_limit_of<std::int64_t>(value, upper) ||
         (upper && (is_limit_of<std::uint32_t>(value, upper) || is_limit_of<std::uint64_t>(value, upper))) ||
         is_limit_of<float>(value, upper) || is_limit_of<double>(value, upper);
}

std::string bound_text(double value) {
  if (value == std::floor(value) && std::fabs(value) < 1e15) return std::to_string(static_cast<std::int64_t>(value));
  return shortest_number(value);
}

}  // namespace

std::string shortest_number(double value) {
  SEMFIELD_CHECK(std::isfinite(value), "a parameter must be finite to be written");
  std::array<char, 32> buffer{};
  const auto end = std::to_chars(buffer.data(), buffer.data() + buffer.size(), value).ptr;
  std::string text(buffer.data(), end);
  // Readers of YAML 1.1 take "1e-05" for a text: a number has a point.
  if (text.find('.') == std::string::npos) text.insert(std::min(text.find('e'), text.size()), ".0");
  return text;
}

ConfigNode params_to_config(const Describe& describe) {
  std::vector<ConfigNode::Entry> entries;
  each_param(describe, [&](const ParamInfo& info, const auto& value) {
    entries.emplace_back(std::string(info.name), node_of(value));
  });
  return ConfigNode::make_map(std::move(entries), {});
}

std::string range_text(const Range& range, bool hide_type_limits) {
  const auto is_open = [&](double value, bool upper) {
    return std::isinf(value) || (hide_type_limits && is_type_limit(value, upper));
  };
  const bool low_open = is_open(range.min, false), high_open = is_open(range.max, true);
  if (low_open && high_open) return {};
  if (high_open) return ">= " + bound_text(range.min);
  if (low_open) return "<= " + bound_text(range.max);
  return "[" + bound_text(range.min) + ", " + bound_text(range.max) + "]";
}

std::vector<ParamDoc> describe_params(const Describe& describe) {
  std::vector<ParamDoc> docs;
  each_param(describe, [&]<class T>(const ParamInfo& info, const T& value) {
    ParamDoc& doc = docs.emplace_back();
    doc.name = info.name;
    doc.type = kTypeName<T>;
    doc.help = info.help;
    doc.range = range_text(info.range, true);
    doc.default_value = write_config_inline(node_of(value));
    if constexpr (std::is_same_v<T, ChosenName>) doc.choices.assign(value.names.begin(), value.names.end());
  });
  return docs;
}

}  // namespace semfield
