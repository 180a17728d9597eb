// From the tree back to plain YAML: block maps and lists, lists of scalars in one line.
#include <algorithm>
#include <array>
#include <cstdio>

#include "config/config_tree.h"
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

void append_escape(std::string& out, unsigned code) {
  std::array<char, 12> buffer{};
  std::snprintf(buffer.data(), buffer.size(), code < 0x100 ? "\\x%02x" : "\\u%04x", code);
  out += buffer.data();
}

std::string in_quotes(std::string_view text) {
  std::string out = "\"";
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto byte = static_cast<unsigned char>(text[i]);
    const std::string_view rest = text.substr(i);
    if (byte == '"' || byte == '\\') {
      out += '\\';
      out += text[i];
    } else if (byte == '\n') {
      out += "\\n";
    } else if (byte == '\t') {
      out += "\\t";
    } else if (byte < 0x20 || byte == 0x7F) {
      append_escape(out, byte);
    } else if (byte == 0xC2 && rest.size() > 1 && static_cast<unsigned char>(rest[1]) < 0xA0) {  // C1 controls
      append_escape(out, static_cast<unsigned char>(rest[1]));
      ++i;
    } else if (rest.starts_with("\xE2\x80\xA8") || rest.starts_with("\xE2\x80\xA9")) {  // line and paragraph separator
      append_escape(out, rest[2] == '\xA8' ? 0x2028 : 0x2029);
      i += 2;
    } else if (rest.starts_with("\xEF\xBB\xBF")) {  // byte order mark
      append_escape(out, 0xFEFF);
      i += 2;
    } else {
      out += text[i];
    }
  }
  return out + "\"";
}

std::string scalar_text(const ConfigNode& node) {
  if (node.is_null()) return "null";
  const bool plain = !node.quoted() && survives_unquoted(node.text()) && !is_null_word(node.text());
  return plain ? node.text() : in_quotes(node.text());
}

std::string key_text(const std::string& key) {
  return survives_unquoted(key) && !is_null_word(key) ? key : in_quotes(key);
}

bool is_leaf(const ConfigNode& node) { return node.is_scalar() || node.is_null(); }

// What stands in one line: scalars, empty collections, lists of scalars.
bool fits_line(const ConfigNode& node) {
  if (is_leaf(node)) return true;
  if (node.is_map()) return node.entries().empty();
  return std::all_of(node.items().begin(), node.items().end(), is_leaf);
}

void write_inline(const ConfigNode& node, std::string& out) {
  if (is_leaf(node)) {
    out += scalar_text(node);
    return;
  }
  out += node.is_map() ? '{' : '[';
  bool first = true;
  for (const ConfigNode::Entry& entry : node.entries()) {
    out += (first ? "" : ", ") + key_text(entry.first) + ": ";
    write_inline(entry.second, out);
    first = false;
  }
  for (const ConfigNode& item : node.items()) {
    if (!first) out += ", ";
    write_inline(item, out);
    first = false;
  }
  out += node.is_map() ? '}' : ']';
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
    if (fits_line(entry.second)) {
      lines.push_back({head + " " + write_config_inline(entry.second), &entry.second});
    } else {
      lines.push_back({head, nullptr});
      write_block(entry.second, indent + "  ", indent + "  ", lines);
    }
    before = indent;
  }
  for (const ConfigNode& item : node.items()) {
    write_block(item, before + "- ", indent + "  ", lines);
    before = indent;
  }
}

}  // namespace

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
  std::string out;
  write_inline(node, out);
  return out;
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
