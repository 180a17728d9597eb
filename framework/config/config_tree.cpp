// From YAML text to the immutable tree, strictly. The only user of yaml-cpp: its parser sends events, its nodes are
// never built.
#include "config/config_tree.h"

#include <yaml-cpp/eventhandler.h>
#include <yaml-cpp/exceptions.h>
#include <yaml-cpp/mark.h>
#include <yaml-cpp/parser.h>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <sstream>
#include <unordered_set>
#include <utility>

#include "core/error.h"
#include "core/text.h"
#include "system/files.h"

namespace semfield {
namespace {

constexpr std::size_t kMaxBytes = std::size_t{1} << 20;
constexpr int kMaxDepth = 64;
// yaml-cpp queues every token of an unclosed one-line flow collection before its first event, so brackets are counted
// before it runs. Text and comments count as well, hence the generous bound; kMaxDepth is enforced exactly by events.
constexpr int kMaxOpenBrackets = 512;
constexpr std::size_t kMaxKeyBytes = 512;
constexpr const char* kUnclosedQuote = "a quoted text is not closed";

/// The text as yaml-cpp gets it, and how places in it are named.
class Source {
 public:
  Source(std::string_view yaml, std::string name, bool is_value) : name_(std::move(name)), is_value_(is_value) {
    if (yaml.size() > kMaxBytes) {
      throw Error(ErrorKind::config, "config.file.size", name_ + ": larger than 1 MiB",
                  "keep big tables in files of their own");
    }
    normalise(yaml);
    check_characters();
    check_brackets();
  }

  const std::string& text() const { return text_; }

  Location at_offset(std::size_t offset) const {
    if (is_value_) return {name_, 0, 0};
    const auto next = std::upper_bound(line_starts_.begin(), line_starts_.end(), std::min(offset, text_.size()));
    const std::size_t line = static_cast<std::size_t>(next - line_starts_.begin()) - 1;
    return {name_, static_cast<int>(line) + 1, column(line, std::min(offset, text_.size()))};
  }

  Location at(const YAML::Mark& mark) const { return at_offset(mark.pos < 0 ? 0 : static_cast<std::size_t>(mark.pos)); }

  [[noreturn]] void fail(Code code, const Location& where, const std::string& message,
                         const std::string& remedy = {}) const {
    throw Error(ErrorKind::config, code, where.text() + ": " + message, remedy);
  }

  /// False for a quoted scalar at `mark` whose closing quote is missing: yaml-cpp 0.7 takes it when a line end follows.
  bool quote_closes(const YAML::Mark& mark) const {
    const auto begin = static_cast<std::size_t>(std::max(mark.pos, 0));
    if (begin >= text_.size() || (text_[begin] != '\'' && text_[begin] != '"')) return true;
    const char quote = text_[begin];
    for (std::size_t i = begin + 1; i < text_.size(); ++i) {
      if (quote == '"' && text_[i] == '\\') {
        ++i;
      } else if (text_[i] == quote) {
        if (quote == '"' || i + 1 == text_.size() || text_[i + 1] != quote) return true;
        ++i;  // '' inside single quotes is one quote
      }
    }
    return false;
  }

  /// True when the line of `where` starts with blanks of which one is a tab.
  bool indented_by_tab(const Location& where) const {
    if (where.line < 1 || static_cast<std::size_t>(where.line) > line_starts_.size()) return false;
    std::size_t i = line_starts_[static_cast<std::size_t>(where.line) - 1];
    while (i < text_.size() && text_[i] == ' ') ++i;
    return i < text_.size() && text_[i] == '\t';
  }

 private:
  // Columns count characters, not bytes. Places come in rising order, so counting goes on from the last one.
  int column(std::size_t line, std::size_t offset) const {
    if (line != column_line_ || offset < column_offset_) {
      column_line_ = line;
      column_offset_ = line_starts_[line];
      column_ = 1;
    }
    for (; column_offset_ < offset; ++column_offset_) {
      column_ += (static_cast<unsigned char>(text_[column_offset_]) & 0xC0u) != 0x80u ? 1 : 0;
    }
    return column_;
  }

  // Drops a byte order mark and turns CR LF and CR into LF.
  void normalise(std::string_view yaml) {
    if (yaml.substr(0, 3) == "\xEF\xBB\xBF") yaml.remove_prefix(3);
    text_.reserve(yaml.size());
    for (std::size_t i = 0; i < yaml.size(); ++i) {
      if (yaml[i] != '\r') {
        text_ += yaml[i];
      } else if (i + 1 == yaml.size() || yaml[i + 1] != '\n') {
        text_ += '\n';
      }
    }
    line_starts_.push_back(0);
    for (std::size_t i = 0; i < text_.size(); ++i) {
      if (text_[i] == '\n') line_starts_.push_back(i + 1);
    }
  }

  // UTF-8 without control characters.
  void check_characters() const {
    for (std::size_t i = 0; i < text_.size();) {
      const auto byte = static_cast<unsigned char>(text_[i]);
      if (byte == 0) fail("config.text.encoding", at_offset(i), "NUL byte: this is not a text file");
      if ((byte < 0x20 && byte != '\t' && byte != '\n') || byte == 0x7F) {
        fail("config.text.encoding", at_offset(i), "control character " + std::to_string(byte),
             "write it as an escape in double quotes");
      }
      const std::size_t length = utf8_length(text_, i);
      if (length == 0) fail("config.text.encoding", at_offset(i), "not valid UTF-8", "save the file as UTF-8");
      i += length;
    }
  }

  void check_brackets() const {
    int open = 0;
    for (std::size_t i = 0; i < text_.size(); ++i) {
      if (text_[i] == '[' || text_[i] == '{') {
        if (++open > kMaxOpenBrackets) {
          fail("config.yaml.depth", at_offset(i), "nested deeper than " + std::to_string(kMaxDepth) + " levels");
        }
      } else if ((text_[i] == ']' || text_[i] == '}') && open > 0) {
        --open;
      }
    }
  }

  std::string name_;
  bool is_value_;
  std::string text_;
  std::vector<std::size_t> line_starts_;
  mutable std::size_t column_line_ = 0, column_offset_ = 0;
  mutable int column_ = 1;
};

/// Builds the tree from parser events and refuses on sight what the tree does not allow.
class TreeBuilder final : public YAML::EventHandler {
 public:
  explicit TreeBuilder(const Source& source) : source_(source) {}

  bool has_document() const { return documents_ > 0; }
  ConfigNode take_root() { return std::move(root_); }

  void OnDocumentStart(const YAML::Mark& mark) override {
    if (++documents_ > 1)
      source_.fail("config.yaml.unsupported", source_.at(mark), "more than one YAML document",
                   "keep one document in a file");
  }
  void OnDocumentEnd() override {}

  void OnAnchor(const YAML::Mark& mark, const std::string& name) override { refuse_anchor(mark, name); }
  void OnAlias(const YAML::Mark& mark, YAML::anchor_t) override {
    source_.fail("config.yaml.unsupported", source_.at(mark), "aliases are not allowed",
                 "use 'include' or write the value out");
  }
  void OnNull(const YAML::Mark& mark, YAML::anchor_t anchor) override {
    if (anchor != 0) refuse_anchor(mark, {});
    Location where = source_.at(mark);
    // The parser puts a missing value where the next token is; the reader looks for it beside its key.
    if (expects_value() && where.line != stack_.back().key_where.line) where = stack_.back().key_where;
    add(ConfigNode::make_null(where), where);
  }
  void OnScalar(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t anchor,
                const std::string& value) override {
    check_properties(mark, tag, anchor);
    const Location where = source_.at(mark);
    if (tag == "!" && !source_.quote_closes(mark)) source_.fail("config.yaml.syntax", where, kUnclosedQuote);
    if (value.find('\0') != std::string::npos) source_.fail("config.text.encoding", where, "NUL character in a text");
    add(ConfigNode::make_scalar(value, tag == "!", where), where);
  }
  void OnSequenceStart(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t anchor,
                       YAML::EmitterStyle::value) override {
    open(mark, tag, anchor, true);
  }
  void OnSequenceEnd() override { close(); }
  void OnMapStart(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t anchor,
                  YAML::EmitterStyle::value) override {
    open(mark, tag, anchor, false);
  }
  void OnMapEnd() override { close(); }

 private:
  struct Level {
    bool is_list = false;
    Location where;
    std::vector<ConfigNode> items;
    std::vector<ConfigNode::Entry> entries;
    std::unordered_set<std::string> keys;
    bool has_key = false;  // a key has come, its value not yet
    std::string key;
    Location key_where;
  };

  bool expects_value() const { return !stack_.empty() && !stack_.back().is_list && stack_.back().has_key; }
  bool expects_key() const { return !stack_.empty() && !stack_.back().is_list && !stack_.back().has_key; }

  [[noreturn]] void refuse_anchor(const YAML::Mark& mark, const std::string& name) const {
    source_.fail("config.yaml.unsupported", source_.at(mark),
                 "anchors are not allowed" + (name.empty() ? "" : " ('&" + name + "')"),
                 "use 'include' or write the value out");
  }

  void check_properties(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t anchor) const {
    if (anchor != 0) refuse_anchor(mark, {});
    if (!tag.empty() && tag != "?" && tag != "!") {
      source_.fail("config.yaml.unsupported", source_.at(mark), "tags are not allowed ('" + tag + "')",
                   "write the plain value");
    }
  }

  void open(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t anchor, bool is_list) {
    check_properties(mark, tag, anchor);
    const Location where = source_.at(mark);
    if (static_cast<int>(stack_.size()) >= kMaxDepth) {
      source_.fail("config.yaml.depth", where, "nested deeper than " + std::to_string(kMaxDepth) + " levels");
    }
    if (expects_key())
      source_.fail("config.yaml.syntax", where, "a list or a map where a key should stand (is a bracket left open?)");
    Level level;
    level.is_list = is_list;
    level.where = where;
    stack_.push_back(std::move(level));
  }

  void close() {
    Level level = std::move(stack_.back());
    stack_.pop_back();
    const Location where = level.where;
    add(level.is_list ? ConfigNode::make_list(std::move(level.items), where)
                      : ConfigNode::make_map(std::move(level.entries), where),
        where);
  }

  void add(ConfigNode node, const Location& where) {
    if (stack_.empty()) {
      root_ = std::move(node);
      return;
    }
    Level& level = stack_.back();
    if (level.is_list) {
      level.items.push_back(std::move(node));
    } else if (!level.has_key) {
      set_key(level, node, where);
    } else {
      level.entries.emplace_back(std::move(level.key), node.with_key_location(level.key_where));
      level.has_key = false;
    }
  }

  void set_key(Level& level, const ConfigNode& node, const Location& where) const {
    if (!node.is_scalar()) source_.fail("config.yaml.syntax", where, "a key is missing before ':'");
    if (node.text().empty()) source_.fail("config.yaml.syntax", where, "a key must not be empty");
    if (node.text().size() > kMaxKeyBytes) source_.fail("config.yaml.syntax", where, "a key longer than 512 bytes");
    if (node.text() == "<<" && !node.quoted()) {
      source_.fail("config.yaml.unsupported", where, "merge keys are not allowed",
                   "use 'include' or write the values out");
    }
    if (!level.keys.insert(node.text()).second) {
      std::string first;
      for (const ConfigNode::Entry& entry : level.entries) {
        if (entry.first == node.text()) first = entry.second.key_location().text();
      }
      source_.fail("config.key.twice", where, "duplicate key '" + node.text() + "' (first at " + first + ")",
                   "keep one of them");
    }
    level.key = node.text();
    level.key_where = where;
    level.has_key = true;
  }

  const Source& source_;
  int documents_ = 0;
  ConfigNode root_;
  std::vector<Level> stack_;
};

// What yaml-cpp's shortest messages mean to the person who wrote the file.
std::string plain_message(const std::string& message) {
  if (message == YAML::ErrorMsg::MAP_VALUE) return "a ':' where no key can stand (quote texts that contain ': ')";
  if (message == YAML::ErrorMsg::UNKNOWN_TOKEN) return "this character cannot start a value here (quote the text)";
  if (message == YAML::ErrorMsg::END_OF_MAP_FLOW) return "a '{' or an entry of it is not closed";
  if (message == YAML::ErrorMsg::END_OF_SEQ_FLOW) return "a '[' or an item of it is not closed";
  if (message == YAML::ErrorMsg::EOF_IN_SCALAR) return kUnclosedQuote;
  if (message == YAML::ErrorMsg::FLOW_END) return "a closing bracket without an opening one";
  if (message == YAML::ErrorMsg::BLOCK_ENTRY) return "a '-' where no list item can stand";
  if (message.starts_with(YAML::ErrorMsg::UNKNOWN_ANCHOR))  // yaml-cpp 0.8 adds the name
    return "aliases are not allowed (use 'include' or write the value out)";
  if (message == YAML::ErrorMsg::END_OF_MAP || message == YAML::ErrorMsg::END_OF_SEQ)
    return "this line is indented like nothing above it (align it with its neighbours)";
  return message;
}

ConfigNode parse(std::string_view yaml, const std::string& name, bool is_value) {
  const Source source(yaml, name, is_value);
  TreeBuilder builder(source);
  std::istringstream stream(source.text());
  try {
    YAML::Parser parser(stream);
    while (parser.HandleNextDocument(builder)) {
    }
  } catch (const YAML::Exception& error) {
    const Location where = source.at(error.mark);
    if (source.indented_by_tab(where))
      source.fail("config.yaml.syntax", where, "a tab cannot indent YAML", "use spaces");
    source.fail("config.yaml.syntax", where, plain_message(error.msg));
  }
  if (builder.has_document()) return builder.take_root();
  return is_value ? ConfigNode::make_null({name, 0, 0}) : ConfigNode::make_map({}, {name, 1, 1});
}

}  // namespace

ConfigNode parse_config_text(std::string_view yaml, const std::string& name) { return parse(yaml, name, false); }

ConfigNode parse_config_value(std::string_view yaml, const std::string& origin) { return parse(yaml, origin, true); }

ConfigNode parse_config_file(const std::string& path) {
  std::error_code unknown;
  if (std::filesystem::is_directory(path, unknown)) {
    throw Error(ErrorKind::no_input, "config.file.folder", "'" + path + "' is a folder, not a config file",
                std::filesystem::exists(std::filesystem::path(path) / "run.yaml")
                    ? "it is a run, whose configuration is its run.yaml"
                    : "`semfield init " + shell_word(path) + "` writes one for the scene in it");
  }
  // One byte more than allowed is enough to see that a file is too large; devices and pipes have no size to ask for.
  const auto size = std::filesystem::file_size(path, unknown);
  if (!unknown && size > kMaxBytes) {
    throw Error(ErrorKind::config, "config.file.size", path + ": larger than 1 MiB",
                "keep big tables in files of their own");
  }
  return parse_config_text(read_text_file(path, kMaxBytes), path);
}

}  // namespace semfield
