// The immutable configuration tree: building, looking up, comparing.
#include <algorithm>
#include <utility>

#include "config/config_tree.h"

namespace semfield {

std::string Location::text() const {
  if (line == 0) return file;
  return file + ":" + std::to_string(line) + ":" + std::to_string(column);
}

struct ConfigNode::Data {
  Kind kind = Kind::map;
  bool quoted = false;
  bool has_key_place = false;
  std::string text;
  std::vector<ConfigNode> items;
  std::vector<Entry> entries;
  Location where;
  Location key_where;
};

ConfigNode::ConfigNode() {
  static const auto empty = std::make_shared<const Data>();
  data_ = empty;
}

ConfigNode ConfigNode::make_null(Location where) {
  auto data = std::make_shared<Data>();
  data->kind = Kind::null;
  data->where = std::move(where);
  ConfigNode node;
  node.data_ = std::move(data);
  return node;
}

ConfigNode ConfigNode::make_scalar(std::string text, bool quoted, Location where) {
  auto data = std::make_shared<Data>();
  data->kind = Kind::scalar;
  data->text = std::move(text);
  data->quoted = quoted;
  data->where = std::move(where);
  ConfigNode node;
  node.data_ = std::move(data);
  return node;
}

ConfigNode ConfigNode::make_list(std::vector<ConfigNode> items, Location where) {
  auto data = std::make_shared<Data>();
  data->kind = Kind::list;
  data->items = std::move(items);
  data->where = std::move(where);
  ConfigNode node;
  node.data_ = std::move(data);
  return node;
}

ConfigNode ConfigNode::make_map(std::vector<Entry> entries, Location where) {
  auto data = std::make_shared<Data>();
  data->kind = Kind::map;
  data->entries = std::move(entries);
  data->where = std::move(where);
  ConfigNode node;
  node.data_ = std::move(data);
  return node;
}

ConfigNode::Kind ConfigNode::kind() const { return data_->kind; }
const Location& ConfigNode::location() const { return data_->where; }
const Location& ConfigNode::key_location() const { return data_->has_key_place ? data_->key_where : data_->where; }
const std::string& ConfigNode::text() const { return data_->text; }
bool ConfigNode::quoted() const { return data_->quoted; }
const std::vector<ConfigNode>& ConfigNode::items() const { return data_->items; }
const std::vector<ConfigNode::Entry>& ConfigNode::entries() const { return data_->entries; }

ConfigNode ConfigNode::with_key_location(Location where) const {
  auto data = std::make_shared<Data>(*data_);
  data->key_where = std::move(where);
  data->has_key_place = true;
  ConfigNode node;
  node.data_ = std::move(data);
  return node;
}

const ConfigNode* ConfigNode::find(std::string_view key) const {
  for (const Entry& entry : data_->entries) {
    if (entry.first == key) return &entry.second;
  }
  return nullptr;
}

ConfigNode ConfigNode::with(const std::string& key, ConfigNode value) const {
  auto data = std::make_shared<Data>(*data_);
  data->kind = Kind::map;  // setting a key of an empty place makes it a map
  const auto place =
      std::find_if(data->entries.begin(), data->entries.end(), [&](const Entry& entry) { return entry.first == key; });
  if (place != data->entries.end()) {
    place->second = std::move(value);
  } else {
    data->entries.emplace_back(key, std::move(value));
  }
  ConfigNode node;
  node.data_ = std::move(data);
  return node;
}

ConfigNode ConfigNode::without(std::string_view key) const {
  auto data = std::make_shared<Data>(*data_);
  std::erase_if(data->entries, [&](const Entry& entry) { return entry.first == key; });
  ConfigNode node;
  node.data_ = std::move(data);
  return node;
}

bool equal_config(const ConfigNode& a, const ConfigNode& b) {
  if (a.kind() != b.kind()) return false;
  switch (a.kind()) {
    case ConfigNode::Kind::null:
      return true;
    case ConfigNode::Kind::scalar:
      return a.text() == b.text() && (a.quoted() == b.quoted() || !looks_typed(a.text()));
    case ConfigNode::Kind::list:
      return std::equal(a.items().begin(), a.items().end(), b.items().begin(), b.items().end(), equal_config);
    case ConfigNode::Kind::map:
      return std::equal(a.entries().begin(), a.entries().end(), b.entries().begin(), b.entries().end(),
                        [](const ConfigNode::Entry& x, const ConfigNode::Entry& y) {
                          return x.first == y.first && equal_config(x.second, y.second);
                        });
  }
  return false;
}

}  // namespace semfield
