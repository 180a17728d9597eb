// What a composed configuration is made of, and how two differ, as text.
#include "config/explain.h"

#include <algorithm>
#include <string_view>
#include <utility>

#include "config/overrides.h"

namespace semfield {
namespace {

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
  return static_cast<std::size_t>(
      std::count_if(text.begin(), text.end(), [](char c) { return (static_cast<unsigned char>(c) & 0xC0u) != 0x80u; }));
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

std::string kind_text(const ConfigNode& node) {
  if (node.is_null()) return "nothing";
  if (node.is_scalar()) return (node.quoted() ? "text '" : "'") + node.text() + "'";
  return node.is_list() ? "a list" : "a map";
}

std::string explain_config(const ConfigNode& node) {
  const std::vector<ConfigLine> lines = config_lines(node);
  std::size_t column = 0;
  for (const ConfigLine& line : lines) {
    const std::size_t line_width = width(line.text);
    if (line.node != nullptr && line_width <= kWidestColumn) column = std::max(column, line_width);
  }
  std::string out;
  for (const ConfigLine& line : lines) {
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

}  // namespace semfield
