#include "config/config_tree.h"

#include <algorithm>

namespace semfield {

std::string Location::text() const {
  if (line == 0) return file;
  return file + ":" + std::to_string(line) + ":" + std::to_string(column);
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

}  // namespace semfield
