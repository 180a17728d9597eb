// From files to one tree: YAML is read strictly, then what a file includes, and what is set over it.
// The only user of yaml-cpp, and of its events alone: its nodes tell neither anchors nor the places of aliases, and a
// few aliases of aliases make a tree without bound.

#include <yaml-cpp/eventhandler.h>
#include <yaml-cpp/exceptions.h>
#include <yaml-cpp/mark.h>
#include <yaml-cpp/parser.h>

#include <algorithm>
#include <optional>
#include <sstream>
#include <system_error>
#include <unordered_set>
#include <utility>

#include "config/config_words.h"
#include "config/explain.h"
#include "core/files.h"
#include "core/text.h"

namespace semfield {

namespace {

constexpr std::size_t kMaxBytes = std::size_t{1} << 20;
constexpr int kMaxDepth = 64;
// yaml-cpp queues every token of an unclosed one-line flow collection before its first event, so brackets are counted
// before it runs. Text and comments count as well, hence the generous bound; kMaxDepth is enforced exactly by events.
constexpr int kMaxOpenBrackets = 512;
constexpr std::size_t kMaxKeyBytes = 512;
constexpr const char* kUnclosedQuote = "a quoted text is not closed";

[[noreturn]] void refuse_depth(const Location& where) {
  refuse_at("config.yaml.depth", where, "nested deeper than " + std::to_string(kMaxDepth) + " levels");
}

/// The text as yaml-cpp gets it, and how places in it are named.
class Source {
 public:
  Source(std::string_view yaml, std::string name, bool is_value) : name_(std::move(name)), is_value_(is_value) {
    if (yaml.size() > kMaxBytes) {
      throw Error(ErrorKind::config, "config.file.size", name_ + ": larger than 1 MiB",
                  "keep big tables in files of their own");
    }
    normalise(yaml);
    for (std::size_t i = 0; i < text_.size(); ++i) {
      characters_.push_back(characters_.back() + (continues_utf8(text_[i]) ? 0 : 1));
      if (text_[i] == '\n') lines_.push_back(i + 1);
    }
    check_characters();
    check_brackets();
  }

  const std::string& text() const { return text_; }

  /// Columns count characters, not bytes.
  Location at(std::size_t offset) const {
    if (is_value_) return {name_, 0, 0};
    offset = std::min(offset, text_.size());
    const auto line = std::upper_bound(lines_.begin(), lines_.end(), offset) - lines_.begin();
    const std::size_t begin = lines_[static_cast<std::size_t>(line) - 1];
    return {name_, static_cast<int>(line), characters_[offset] - characters_[begin] + 1};
  }
  Location at(const YAML::Mark& mark) const { return at(offset_of(mark)); }

  /// False for a quoted scalar at `mark` whose closing quote is missing: yaml-cpp 0.7 takes it when a line end follows.
  bool quote_closes(const YAML::Mark& mark) const {
    const std::size_t begin = offset_of(mark);
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
    const std::size_t offset = std::min(offset_of(mark), text_.size());
    const std::size_t begin = offset == 0 ? 0 : text_.rfind('\n', offset - 1) + 1;
    const std::size_t first = text_.find_first_not_of(' ', begin);
    return !is_value_ && first != std::string::npos && text_[first] == '\t';
  }

 private:
  static std::size_t offset_of(const YAML::Mark& mark) { return static_cast<std::size_t>(std::max(mark.pos, 0)); }

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
      if (byte == 0) refuse_at("config.text.encoding", at(i), "NUL byte: this is not a text file");
      if ((byte < 0x20 && byte != '\t' && byte != '\n') || byte == 0x7F) {
        refuse_at("config.text.encoding", at(i), "control character " + std::to_string(byte),
                  "write it as an escape in double quotes");
      }
      const std::size_t length = utf8_length(text_, i);
      if (length == 0) refuse_at("config.text.encoding", at(i), "not valid UTF-8", "save the file as UTF-8");
      i += length;
    }
  }

  void check_brackets() const {
    int open = 0;
    for (std::size_t i = 0; i < text_.size(); ++i) {
      if (text_[i] == '[' || text_[i] == '{') {
        if (++open > kMaxOpenBrackets) refuse_depth(at(i));
      } else if ((text_[i] == ']' || text_[i] == '}') && open > 0) {
        --open;
      }
    }
  }

  std::string name_;
  bool is_value_;
  std::string text_;
  std::vector<int> characters_{0};     // before each byte of the text, and at its end
  std::vector<std::size_t> lines_{0};  // where they begin
};

/// Builds the tree from parser events and refuses on sight what the tree does not allow.
class TreeBuilder final : public YAML::EventHandler {
 public:
  explicit TreeBuilder(const Source& source) : source_(source) {}

  bool has_document() const { return documents_ > 0; }
  ConfigNode take_root() { return std::move(root_); }

  void OnDocumentStart(const YAML::Mark& mark) override {
    if (++documents_ > 1)
      refuse_at("config.yaml.unsupported", source_.at(mark), "more than one YAML document",
                "keep one document in a file");
  }
  void OnDocumentEnd() override {}

  void OnAnchor(const YAML::Mark& mark, const std::string& name) override {
    refuse_at("config.yaml.unsupported", source_.at(mark), "anchors are not allowed ('&" + name + "')",
              "use 'include' or write the value out");
  }
  void OnAlias(const YAML::Mark& mark, YAML::anchor_t) override {
    refuse_at("config.yaml.unsupported", source_.at(mark), "aliases are not allowed",
              "use 'include' or write the value out");
  }
  void OnNull(const YAML::Mark& mark, YAML::anchor_t) override {
    Location where = source_.at(mark);
    // The parser puts a missing value where the next token is; the reader looks for it beside its key.
    if (in_map() && stack_.back().key && where.line != stack_.back().key->second.line)
      where = stack_.back().key->second;
    add(ConfigNode::make_null(std::move(where)));
  }
  void OnScalar(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t, const std::string& value) override {
    check_tag(mark, tag);
    const Location where = source_.at(mark);
    if (tag == "!" && !source_.quote_closes(mark)) refuse_at("config.yaml.syntax", where, kUnclosedQuote);
    if (value.find('\0') != std::string::npos) refuse_at("config.text.encoding", where, "NUL character in a text");
    add(ConfigNode::make_scalar(value, tag == "!", where));
  }
  void OnSequenceStart(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t,
                       YAML::EmitterStyle::value) override {
    check_tag(mark, tag);
    open(ConfigNode::make_list({}, source_.at(mark)));
  }
  void OnSequenceEnd() override { close(); }
  void OnMapStart(const YAML::Mark& mark, const std::string& tag, YAML::anchor_t, YAML::EmitterStyle::value) override {
    check_tag(mark, tag);
    open(ConfigNode::make_map({}, source_.at(mark)));
  }
  void OnMapEnd() override { close(); }

 private:
  struct Level {
    ConfigNode node;  // a list or a map
    std::unordered_set<std::string> keys = {};
    std::optional<std::pair<std::string, Location>> key = {};  // one that has come, its value not yet
  };

  bool in_map() const { return !stack_.empty() && stack_.back().node.is_map(); }

  void check_tag(const YAML::Mark& mark, const std::string& tag) const {
    if (tag.empty() || tag == "?" || tag == "!") return;
    refuse_at("config.yaml.unsupported", source_.at(mark), "tags are not allowed ('" + tag + "')",
              "write the plain value");
  }

  void open(ConfigNode node) {
    if (static_cast<int>(stack_.size()) >= kMaxDepth) refuse_depth(node.location());
    if (in_map() && !stack_.back().key)
      refuse_at("config.yaml.syntax", node.location(),
                "a list or a map where a key should stand (is a bracket left open?)");
    stack_.push_back({std::move(node)});
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
    if (!node.is_scalar()) refuse_at("config.yaml.syntax", where, "a key is missing before ':'");
    if (key.empty()) refuse_at("config.yaml.syntax", where, "a key must not be empty");
    if (key.size() > kMaxKeyBytes) refuse_at("config.yaml.syntax", where, "a key longer than 512 bytes");
    if (key == "<<" && !node.quoted()) {
      refuse_at("config.yaml.unsupported", where, "merge keys are not allowed",
                "use 'include' or write the values out");
    }
    if (!level.keys.insert(key).second) {
      refuse_at("config.key.twice", where,
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

// What yaml-cpp's shortest messages mean to the person who wrote the file; 0.8 adds a name to that of an anchor.
const std::pair<std::string_view, const char*> kMessages[] = {
    {YAML::ErrorMsg::MAP_VALUE, "a ':' where no key can stand (quote texts that contain ': ')"},
    {YAML::ErrorMsg::UNKNOWN_TOKEN, "this character cannot start a value here (quote the text)"},
    {YAML::ErrorMsg::END_OF_MAP_FLOW, "a '{' or an entry of it is not closed"},
    {YAML::ErrorMsg::END_OF_SEQ_FLOW, "a '[' or an item of it is not closed"},
    {YAML::ErrorMsg::EOF_IN_SCALAR, kUnclosedQuote},
    {YAML::ErrorMsg::FLOW_END, "a closing bracket without an opening one"},
    {YAML::ErrorMsg::BLOCK_ENTRY, "a '-' where no list item can stand"},
    {YAML::ErrorMsg::UNKNOWN_ANCHOR, "aliases are not allowed (use 'include' or write the value out)"},
    {YAML::ErrorMsg::END_OF_MAP, "this line is indented like nothing above it (align it with its neighbours)"},
    {YAML::ErrorMsg::END_OF_SEQ, "this line is indented like nothing above it (align it with its neighbours)"},
};

std::string plain_message(const std::string& message) {
  for (const auto& [theirs, ours] : kMessages)
    if (message.starts_with(theirs)) return ours;
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
      refuse_at("config.yaml.syntax", where, "a tab cannot indent YAML", "use spaces");
    refuse_at("config.yaml.syntax", where, plain_message(error.msg));
  }
  if (builder.has_document()) return builder.take_root();
  return is_value ? ConfigNode::make_null({name, 0, 0}) : ConfigNode::make_map({}, {name, 1, 1});
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

// Files with what they include.

namespace {

// More than anyone writes, few enough that a file including two others over and over ends at once.
constexpr int kMaxIncludedFiles = 256;
constexpr int kMaxIncludeDepth = 32;

/// Loads files with their includes; knows which files are open now (cycles) and how many were read.
class Loader {
 public:
  /// `problems`: where mistakes of includes go instead of being thrown; null: nowhere.
  explicit Loader(Diagnostics* problems = nullptr) : problems_(problems) {}

  ConfigNode load(const std::string& path) {
    open_.push_back(path);
    ConfigNode composed = with_includes(parse_config_file(path));
    open_.pop_back();
    return composed;
  }

  ConfigNode with_includes(const ConfigNode& local) {
    if (!local.is_map()) {
      refuse_at("config.value.type", local.location(),
                "expected a map of sections at the top, got " + kind_text(local));
    }
    ConfigNode composed = ConfigNode::make_map({}, local.location());
    if (const ConfigNode* include = local.find("include")) {
      for (const ConfigNode& item : include->is_list() ? include->items() : std::vector<ConfigNode>{*include}) {
        const std::size_t open = open_.size();
        noting(problems_, [&] { composed = merge_config(composed, load_included(item)); });
        open_.resize(open);
      }
    }
    composed = merge_config(std::move(composed), local.without("include").without("overrides"));
    if (const ConfigNode* over = local.find("overrides"); over != nullptr && !over->is_null())
      noting(problems_, [&] { set_values(composed, overrides_of(*over, "overrides"), problems_); });
    return composed;
  }

 private:
  ConfigNode load_included(const ConfigNode& item) {
    if (!item.is_scalar())
      refuse_at("config.include.file", item.location(), "include: expected a file name, got " + kind_text(item));
    const fs::path written(item.text());
    fs::path path =
        written.is_absolute() ? written : (fs::path(item.location().file).parent_path() / written).lexically_normal();
    if (!is_there(path) || is_folder(path)) {
      const std::string shipped = shipped_config(item.text());
      if (shipped.empty()) {
        const std::string place = shipped_place(item.text());
        std::string near = near_config(item.text(), path.string());
        if (!near.empty() && !near.ends_with(".yaml")) near += ".yaml";  // which an include has to write
        if (near == item.text()) near.clear();                           // a folder of that name
        noting(problems_, [&] {
          refuse_at("config.include.file", item.location(),
                    "include: no file '" + item.text() + "' (looked for '" + path.string() + "'" +
                        (place.empty() ? ")" : " and '" + place + "')"),
                    near.empty() ? "paths in a config are relative to the file that wrote them"
                                 : "did you mean '" + near + "'?");
        });
        // What else is wrong is known by the file that was meant.
        return near.empty() ? ConfigNode::make_map({}, item.location())
                            : load_included(ConfigNode::make_scalar(near, false, item.location()));
      }
      path = shipped;
    }
    const auto first = std::find_if(open_.begin(), open_.end(), [&](const std::string& file) {
      std::error_code unknown;
      return fs::equivalent(file, path, unknown);
    });
    if (first != open_.end()) {
      refuse_at(
          "config.include.cycle", item.location(),
          "include: '" + item.text() + "' includes itself: " + join({first, open_.end()}, " -> ") + " -> " + *first);
    }
    if (open_.size() >= kMaxIncludeDepth || ++included_ > kMaxIncludedFiles) {
      refuse_at("config.include.limit", item.location(),
                "include: more than " + std::to_string(kMaxIncludedFiles) + " files or " +
                    std::to_string(kMaxIncludeDepth) + " levels");
    }
    return load(path.string());
  }

  Diagnostics* problems_;
  std::vector<std::string> open_;  // the file that is read, behind those that include it
  int included_ = 0;
};

}  // namespace

ConfigNode compose_config(const std::string& path, const std::vector<std::string>& overrides, Diagnostics* problems) {
  ConfigNode tree = Loader(problems).load(find_config(path));
  return with_overrides(std::move(tree), parse_overrides(overrides, problems), problems);
}

ConfigNode compose_config_with(const std::string& path, const std::vector<ConfigOverride>& overrides) {
  return with_overrides(Loader().load(find_config(path)), overrides);
}

ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<ConfigOverride>& overrides) {
  return with_overrides(Loader().with_includes(tree), overrides);
}

std::string resolve_path(const ConfigNode& scalar) {
  const fs::path written(scalar.text());
  if (written.is_absolute()) return written.lexically_normal().string();
  const Location& where = scalar.location();
  // An override is written on the command line: its paths are relative to the working folder, as are those of no file.
  const fs::path folder = where.line == 0 ? fs::path() : fs::path(where.file).parent_path();
  return fs::absolute(folder / written).lexically_normal().string();
}

}  // namespace semfield
