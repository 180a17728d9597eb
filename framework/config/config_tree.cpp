// From YAML text to the tree, strictly. The only user of yaml-cpp: its parser sends events, its nodes are never built,
// since they tell neither anchors nor keys that stand twice.
#include "config/config_tree.h"

#include <yaml-cpp/eventhandler.h>
#include <yaml-cpp/exceptions.h>
#include <yaml-cpp/mark.h>
#include <yaml-cpp/parser.h>

#include <algorithm>
#include <array>
#include <cstdio>
#include <filesystem>
#include <sstream>
#include <unordered_set>

#include "core/error.h"
#include "core/text.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

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

  /// Columns count characters, not bytes. Places are asked for in rising order, so counting resumes at the last one.
  Location at_offset(std::size_t offset) const {
    if (is_value_) return {name_, 0, 0};
    if (offset < line_begin_) line_begin_ = 0, line_ = 1;
    if (offset < offset_) offset_ = line_begin_, column_ = 1;
    for (; offset_ < std::min(offset, text_.size()); ++offset_) {
      if (text_[offset_] == '\n') {
        ++line_;
        line_begin_ = offset_ + 1;
        column_ = 1;
      } else {
        column_ += (static_cast<unsigned char>(text_[offset_]) & 0xC0u) != 0x80u ? 1 : 0;
      }
    }
    return {name_, line_, column_};
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

  /// True when the line of `mark` starts with blanks of which one is a tab.
  bool indented_by_tab(const YAML::Mark& mark) const {
    const std::size_t offset = std::min(static_cast<std::size_t>(std::max(mark.pos, 0)), text_.size());
    const std::size_t begin = offset == 0 ? 0 : text_.rfind('\n', offset - 1) + 1;
    const std::size_t first = text_.find_first_not_of(' ', begin);
    return !is_value_ && first != std::string::npos && text_[first] == '\t';
  }

 private:
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
  mutable std::size_t offset_ = 0, line_begin_ = 0;
  mutable int line_ = 1, column_ = 1;
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
    if (expects_value() && where.line != stack_.back().key->second.line) where = stack_.back().key->second;
    add(ConfigNode::make_null(std::move(where)));
  }
  void OnScalar(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t anchor,
                const std::string& value) override {
    check_properties(mark, tag, anchor);
    const Location where = source_.at(mark);
    if (tag == "!" && !source_.quote_closes(mark)) source_.fail("config.yaml.syntax", where, kUnclosedQuote);
    if (value.find('\0') != std::string::npos) source_.fail("config.text.encoding", where, "NUL character in a text");
    add(ConfigNode::make_scalar(value, tag == "!", where));
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
    ConfigNode node;  // a list or a map
    std::unordered_set<std::string> keys = {};
    std::optional<std::pair<std::string, Location>> key = {};  // one that has come, its value not yet
  };

  bool in_map() const { return !stack_.empty() && stack_.back().node.is_map(); }
  bool expects_value() const { return in_map() && stack_.back().key; }
  bool expects_key() const { return in_map() && !stack_.back().key; }

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
    stack_.push_back({is_list ? ConfigNode::make_list({}, where) : ConfigNode::make_map({}, where)});
  }

  void close() {
    ConfigNode node = std::move(stack_.back().node);
    stack_.pop_back();
    add(std::move(node));
  }

  void add(ConfigNode node) {
    if (stack_.empty()) {
      root_ = std::move(node);
      return;
    }
    Level& level = stack_.back();
    if (level.node.is_list()) {
      level.node.items().push_back(std::move(node));
    } else if (!level.key) {
      set_key(level, node);
    } else {
      node.set_key_location(std::move(level.key->second));
      level.node.entries().emplace_back(std::move(level.key->first), std::move(node));
      level.key.reset();
    }
  }

  void set_key(Level& level, const ConfigNode& node) const {
    const Location& where = node.location();
    const std::string& key = node.text();
    if (!node.is_scalar()) source_.fail("config.yaml.syntax", where, "a key is missing before ':'");
    if (key.empty()) source_.fail("config.yaml.syntax", where, "a key must not be empty");
    if (key.size() > kMaxKeyBytes) source_.fail("config.yaml.syntax", where, "a key longer than 512 bytes");
    if (key == "<<" && !node.quoted()) {
      source_.fail("config.yaml.unsupported", where, "merge keys are not allowed",
                   "use 'include' or write the values out");
    }
    if (!level.keys.insert(key).second) {
      source_.fail("config.key.twice", where,
                   "duplicate key '" + key + "' (first at " + level.node.find(key)->key_location().text() + ")",
                   "keep one of them");
    }
    level.key.emplace(key, where);
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
    if (source.indented_by_tab(error.mark))
      source.fail("config.yaml.syntax", where, "a tab cannot indent YAML", "use spaces");
    source.fail("config.yaml.syntax", where, plain_message(error.msg));
  }
  if (builder.has_document()) return builder.take_root();
  return is_value ? ConfigNode::make_null({name, 0, 0}) : ConfigNode::make_map({}, {name, 1, 1});
}

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

void append_escape(std::string& out, std::uint32_t code) {
  std::array<char, 12> buffer{};
  std::snprintf(buffer.data(), buffer.size(), code < 0x100 ? "\\x%02x" : "\\u%04x", code);
  out += buffer.data();
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
      append_escape(out, c);
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

ConfigNode parse_config_text(std::string_view yaml, const std::string& name) { return parse(yaml, name, false); }

ConfigNode parse_config_value(std::string_view yaml, const std::string& origin) { return parse(yaml, origin, true); }

ConfigNode parse_config_file(const std::string& path) {
  if (is_folder(path)) {
    throw Error(ErrorKind::no_input, "config.file.folder", "'" + path + "' is a folder, not a config file",
                fs::exists(fs::path(path) / "run.yaml")
                    ? "it is a run, whose configuration is its run.yaml"
                    : "`semfield init " + shell_word(path) + "` writes one for the scene in it");
  }
  return parse_config_text(read_file_start(path, kMaxBytes + 1), path);  // enough to see that a file is too large
}

// The configuration tree: building, looking up, comparing.

std::string Location::text() const {
  if (line == 0) return file;
  return file + ":" + std::to_string(line) + ":" + std::to_string(column);
}

ConfigNode ConfigNode::make_scalar(std::string text, bool quoted, Location where) {
  ConfigNode node(Kind::scalar, std::move(where));
  node.text_ = std::move(text);
  node.quoted_ = quoted;
  return node;
}

ConfigNode ConfigNode::make_list(std::vector<ConfigNode> items, Location where) {
  ConfigNode node(Kind::list, std::move(where));
  node.items_ = std::move(items);
  return node;
}

ConfigNode ConfigNode::make_map(std::vector<Entry> entries, Location where) {
  ConfigNode node(Kind::map, std::move(where));
  node.entries_ = std::move(entries);
  return node;
}

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

// From the tree back to plain YAML: block maps and lists, lists of scalars in one line.

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

// Configurations by name: in the user's folders, then the shipped ones.

namespace {

constexpr const char* kEnding = ".yaml";

bool is_no_folder(const fs::path& path) { return is_there(path) && !is_folder(path); }

// `path`, or with the ending that may be left out; "" when neither is there.
std::string with_ending(const fs::path& path) {
  if (is_no_folder(path)) return path.string();
  fs::path longer = path;
  longer += kEnding;
  return is_no_folder(longer) ? longer.string() : "";
}

// Names without the ending of configurations in the folder that `place`, a path that is not there, would lie in.
void add_neighbours(const fs::path& place, std::vector<std::string>& names) {
  std::error_code unknown;
  const fs::path folder = place.has_parent_path() ? place.parent_path() : fs::path(".");
  for (fs::directory_iterator it(folder, unknown), end; !unknown && it != end; it.increment(unknown)) {
    if (it->path().extension() == kEnding) names.push_back(it->path().stem().string());
  }
}

}  // namespace

std::string shipped_place(const std::string& name) {
  const fs::path written = fs::path(name).lexically_normal();
  const std::string root = shared_root();
  if (root.empty() || written.empty() || written.is_absolute()) return "";
  const bool whole = *written.begin() == "configs";
  return (whole ? fs::path(root) / written : fs::path(root) / "configs" / written).string();
}

std::string shipped_config(const std::string& name) {
  const std::string place = shipped_place(name);
  return place.empty() ? "" : with_ending(place);
}

std::string near_config(const std::string& name, const std::string& own_place) {
  const std::string place = shipped_place(name);
  std::vector<std::string> names;
  add_neighbours(own_place, names);
  if (!place.empty()) add_neighbours(place, names);
  std::sort(names.begin(), names.end());  // of two that are equally near, the same one on every file system
  const fs::path written(name);
  const std::string ending = written.extension() == kEnding ? kEnding : "";
  const std::string near = did_you_mean((ending.empty() ? written.filename() : written.stem()).string(), names);
  return near.empty() ? "" : (written.parent_path() / near).string() + ending;
}

std::string find_config(const std::string& name) {
  if (const std::string own = with_ending(name); !own.empty()) return own;
  if (std::string shipped = shipped_config(name); !shipped.empty()) return shipped;
  if (is_there(name)) return name;  // a folder, which the reader refuses by that name
  const std::string place = shipped_place(name), near = near_config(name, name);
  throw Error(ErrorKind::no_input, "config.file.missing",
              "no configuration '" + name + "'" +
                  (place.empty() ? std::string() : " (looked for '" + name + "' and '" + place + "')"),
              near.empty() ? "check the path" : "did you mean '" + near + "'?");
}

}  // namespace semfield
