// The immutable configuration tree: every node knows its file, line and column. config_tree.cpp is the only user of
// yaml-cpp.
#pragma once

#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace semfield {

/// Where a value was written: a file with 1-based line and column, or "--set a.b=c" with line 0.
struct Location {
  std::string file;
  int line = 0;
  int column = 0;
  std::string text() const;  ///< "room.yaml:7:5", or the file alone when line is 0
};

/// Cheap to copy (shared, immutable). A default-constructed node is an empty map without a place.
class ConfigNode {
 public:
  enum class Kind { null, scalar, list, map };
  using Entry = std::pair<std::string, ConfigNode>;

  ConfigNode();
  static ConfigNode make_null(Location where);
  /// `quoted`: the scalar was written in quotes, so it is text whatever it looks like.
  static ConfigNode make_scalar(std::string text, bool quoted, Location where);
  static ConfigNode make_list(std::vector<ConfigNode> items, Location where);
  static ConfigNode make_map(std::vector<Entry> entries, Location where);

  Kind kind() const;
  bool is_map() const { return kind() == Kind::map; }
  bool is_list() const { return kind() == Kind::list; }
  bool is_scalar() const { return kind() == Kind::scalar; }
  bool is_null() const { return kind() == Kind::null; }
  const Location& location() const;
  /// Where the key of this map entry was written; the value's own place when it is no entry of a parsed map.
  const Location& key_location() const;
  /// A copy that remembers the place of its key.
  ConfigNode with_key_location(Location where) const;
  const std::string& text() const;  ///< scalar text; "" for other kinds
  bool quoted() const;
  const std::vector<ConfigNode>& items() const;  ///< list items; empty for other kinds
  const std::vector<Entry>& entries() const;     ///< map entries in file order; empty for other kinds
  /// Entry `key` of a map, or nullptr.
  const ConfigNode* find(std::string_view key) const;
  /// A copy with `key` set (added at the end or replaced in place).
  ConfigNode with(const std::string& key, ConfigNode value) const;
  ConfigNode without(std::string_view key) const;

 private:
  struct Data;
  std::shared_ptr<const Data> data_;
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

/// One line of written YAML and the node whose value stands on it (nullptr: a bare key or dash).
struct ConfigLine {
  std::string text;
  const ConfigNode* node = nullptr;
};
/// What write_config joins, for writers that add comments; the pointers live as long as `node`.
std::vector<ConfigLine> config_lines(const ConfigNode& node);

}  // namespace semfield
