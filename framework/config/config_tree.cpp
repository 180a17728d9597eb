// The configuration tree: building, looking up, comparing, and back to plain YAML: block maps and lists, lists of
// scalars in one line.
#include "config/config_tree.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstdint>

#include "core/text.h"

namespace semfield {

namespace {

bool is_alnum(char c) { return is_digit(c) || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z'); }

std::string lower(std::string_view text) {
  std::string out(text);
  for (char& c : out) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  return out;
}

bool is_null_word(std::string_view text) { return text.empty() || text == "~" || lower(text) == "null"; }

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

// `lead` stands before the first line ("  - "), `indent` before each further one.
void write_block(const ConfigNode& node, const std::string& lead, const std::string& indent,
                 std::vector<ConfigLine>& lines) {
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

}  // namespace

std::string Location::text() const {
  if (line == 0) return file;
  return file + ":" + std::to_string(line) + ":" + std::to_string(column);
}

void refuse_at(const Location& where, Code code, const std::string& message, const std::string& remedy) {
  throw Error(ErrorKind::config, code, where.text() + ": " + message, remedy);
}

ConfigNode::ConfigNode(Kind kind, Location where, bool quoted, std::string text, std::vector<ConfigNode> items,
                       std::vector<Entry> entries)
    : kind_(kind),
      quoted_(quoted),
      text_(std::move(text)),
      items_(std::move(items)),
      entries_(std::move(entries)),
      where_(std::move(where)) {}

const ConfigNode* ConfigNode::find(std::string_view key) const {
  for (const Entry& entry : entries_) {
    if (entry.first == key) return &entry.second;
  }
  return nullptr;
}

const ConfigNode* ConfigNode::find_path(std::string_view path) const {
  const std::size_t dot = path.find('.');
  const ConfigNode* node = find(path.substr(0, dot));
  return node == nullptr || dot == std::string_view::npos ? node : node->find_path(path.substr(dot + 1));
}

void ConfigNode::set(const std::string& key, ConfigNode value) {
  kind_ = Kind::map;
  if (ConfigNode* const place = find(key)) {
    *place = std::move(value);
  } else {
    entries_.emplace_back(key, std::move(value));
  }
}

void ConfigNode::set_path(std::string_view path, ConfigNode value) {
  const std::size_t dot = path.find('.');
  const std::string key(path.substr(0, dot));
  if (dot == std::string_view::npos) return set(key, std::move(value));
  if (find(key) == nullptr) set(key, {});
  find(key)->set_path(path.substr(dot + 1), std::move(value));
}

ConfigNode ConfigNode::with(const std::string& key, ConfigNode value) const {
  ConfigNode node = *this;
  node.set(key, std::move(value));
  return node;
}

ConfigNode ConfigNode::without(std::string_view key) const {
  ConfigNode node = *this;
  std::erase_if(node.entries_, [&](const Entry& entry) { return entry.first == key; });
  return node;
}

bool equal_config(const ConfigNode& a, const ConfigNode& b) {
  if (a.kind() != b.kind()) return false;
  if (a.is_scalar()) return a.text() == b.text() && (a.quoted() == b.quoted() || !looks_typed(a.text()));
  const auto same_entry = [](const ConfigNode::Entry& x, const ConfigNode::Entry& y) {
    return x.first == y.first && equal_config(x.second, y.second);
  };
  return std::equal(a.items().begin(), a.items().end(), b.items().begin(), b.items().end(), equal_config) &&
         std::equal(a.entries().begin(), a.entries().end(), b.entries().begin(), b.entries().end(), same_entry);
}

bool looks_typed(std::string_view text) {
  if (is_null_word(text)) return true;
  const std::string word = lower(text);
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

std::vector<ConfigLine> config_lines(const ConfigNode& node) {
  std::vector<ConfigLine> lines;
  write_block(node, "", "", lines);
  return lines;
}

std::string write_config(const ConfigNode& node) {
  std::string out;
  for (const ConfigLine& line : config_lines(node)) out += line.text + "\n";
  return out;
}

}  // namespace semfield
