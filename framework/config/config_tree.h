// The configuration tree: every node knows its file, line and column. compose.cpp makes it of YAML, explain.cpp
// writes it.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/error.h"

namespace semfield {

/// Where a value was written: a file with 1-based line and column, or "--set a.b=c" with line 0.
struct Location {
  std::string file;
  int line = 0;
  int column = 0;
  std::string text() const;  ///< "room.yaml:7:5", or the file alone when line is 0
};

/// Throws Error(config): "room.yaml:7:5: MESSAGE".
[[noreturn]] inline void refuse_at(Code code, const Location& where, const std::string& message,
                                   const std::string& remedy = {}) {
  throw Error(ErrorKind::config, code, where.text() + ": " + message, remedy);
}

/// A value with its place. A default-constructed node is an empty map without a place.
class ConfigNode {
 public:
  enum class Kind { null, scalar, list, map };
  using Entry = std::pair<std::string, ConfigNode>;

  static ConfigNode make_null(Location where) { return {Kind::null, std::move(where)}; }
  /// `quoted`: the scalar was written in quotes, so it is text whatever it looks like.
  static ConfigNode make_scalar(std::string text, bool quoted, Location where) {
    return {Kind::scalar, std::move(where), quoted, std::move(text)};
  }
  static ConfigNode make_list(std::vector<ConfigNode> items, Location where) {
    return {Kind::list, std::move(where), false, {}, std::move(items)};
  }
  static ConfigNode make_map(std::vector<Entry> entries, Location where) {
    return {Kind::map, std::move(where), false, {}, {}, std::move(entries)};
  }
  /// What to_node(item) makes of each of `items`.
  template <class Items, class ToNode>
  static ConfigNode list_of(const Items& items, const ToNode& to_node) {
    std::vector<ConfigNode> nodes;
    for (const auto& item : items) nodes.push_back(to_node(item));
    return make_list(std::move(nodes), {});
  }
  ConfigNode() = default;

  bool is_map() const { return kind_ == Kind::map; }
  bool is_list() const { return kind_ == Kind::list; }
  bool is_scalar() const { return kind_ == Kind::scalar; }
  bool is_null() const { return kind_ == Kind::null; }
  Kind kind() const { return kind_; }
  const Location& location() const { return where_; }
  void set_location(Location where) { where_ = std::move(where); }
  /// Where the key of this map entry was written; the value's own place when it is no entry of a parsed map.
  const Location& key_location() const { return key_where_ ? *key_where_ : where_; }
  void set_key_location(Location where) { key_where_ = std::move(where); }
  const std::string& text() const { return text_; }  ///< scalar text; "" for other kinds
  bool quoted() const { return quoted_; }
  /// List items; empty for other kinds.
  const std::vector<ConfigNode>& items() const { return items_; }
  std::vector<ConfigNode>& items() { return items_; }
  /// Map entries in file order; empty for other kinds.
  const std::vector<Entry>& entries() const { return entries_; }
  std::vector<Entry>& entries() { return entries_; }
  /// Entry `key` of a map, or nullptr.
  const ConfigNode* find(std::string_view key) const;
  ConfigNode* find(std::string_view key) { return const_cast<ConfigNode*>(std::as_const(*this).find(key)); }
  /// The node at a path of keys, "train.schedule", or nullptr.
  const ConfigNode* find_path(std::string_view path) const;
  /// The same; nullptr also where nothing is written there.
  const ConfigNode* given(std::string_view path) const {
    const ConfigNode* found = find_path(path);
    return found != nullptr && !found->is_null() ? found : nullptr;
  }
  /// Adds `key` at the end, or replaces it in place. A node that was no map becomes one.
  void set(const std::string& key, ConfigNode value);
  /// The same at a path of keys; maps that are missing are made.
  void set_path(std::string_view path, ConfigNode value);
  /// A copy with `key` set, and one without it.
  ConfigNode with(const std::string& key, ConfigNode value) const;
  ConfigNode without(std::string_view key) const;

 private:
  ConfigNode(Kind kind, Location where, bool quoted = false, std::string text = {}, std::vector<ConfigNode> items = {},
             std::vector<Entry> entries = {});

  Kind kind_ = Kind::map;
  bool quoted_ = false;
  std::string text_;
  std::vector<ConfigNode> items_;
  std::vector<Entry> entries_;
  Location where_;
  std::optional<Location> key_where_;
};

/// Parses one YAML file into the tree. Throws Error(config) naming file:line:column for syntax errors, duplicate keys,
/// aliases/anchors, tags, multiple documents, depth over 64, size over 1 MiB.
ConfigNode parse_config_file(const std::string& path);
/// The same for a text; `name` stands for the file in messages.
ConfigNode parse_config_text(std::string_view yaml, const std::string& name);
/// One value of the command line; every node's place is `origin` with line 0. An empty text is null.
ConfigNode parse_config_value(std::string_view yaml, const std::string& origin);

/// Same kinds, keys in the same order, texts and meaning of quotes ("16" is not 16, "abc" is abc); places are ignored.
bool equal_config(const ConfigNode& a, const ConfigNode& b);

/// Plain YAML text of a tree, keys in order; parsing it gives an equal tree.
std::string write_config(const ConfigNode& node);
/// The same in one line without a line end: "{type: waves, bands: 16}".
std::string write_config_inline(const ConfigNode& node);
/// True for a text that means something else without quotes: a number, a bool, null, or a near miss of one ("010",
/// "no").
bool looks_typed(std::string_view text);
/// True for a text that can stand unquoted anywhere in YAML and is read back as that same text.
bool is_plain_text(std::string_view text);

}  // namespace semfield
