// Composition of configs: include, merge, replace-on-type-change, command line overrides, like.
#include "config/compose.h"

#include <algorithm>
#include <filesystem>
#include <iterator>
#include <string_view>
#include <system_error>
#include <unordered_map>
#include <utility>

#include "config/explain.h"
#include "core/text.h"
#include "system/files.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

// More than anyone writes, few enough that a file including two others over and over ends at once.
constexpr int kMaxIncludedFiles = 256;
constexpr int kMaxIncludeDepth = 32;

[[noreturn]] void fail(Code code, const Location& where, const std::string& message, const std::string& remedy = {}) {
  throw Error(ErrorKind::config, code, where.text() + ": " + message, remedy);
}

const ConfigNode* scalar_type(const ConfigNode& map) {
  const ConfigNode* type = map.find("type");
  return type != nullptr && type->is_scalar() ? type : nullptr;
}

bool type_changes(const ConfigNode& base, const ConfigNode& over) {
  const ConfigNode* old_type = scalar_type(base);
  const ConfigNode* new_type = scalar_type(over);
  return old_type != nullptr && new_type != nullptr && old_type->text() != new_type->text();
}

void merge_into(ConfigNode& base, const ConfigNode& over) {
  if (!base.is_map() || !over.is_map() || type_changes(base, over)) {
    base = over;
    return;
  }
  std::unordered_map<std::string, std::size_t> places;
  for (const ConfigNode::Entry& entry : base.entries()) places.emplace(entry.first, places.size());
  for (const ConfigNode::Entry& entry : over.entries()) {
    const auto [place, is_new] = places.try_emplace(entry.first, base.entries().size());
    if (is_new) {
      base.entries().push_back(entry);
    } else {
      merge_into(base.entries()[place->second].second, entry.second);
    }
  }
  base.set_location(over.location());
  base.set_key_location(over.key_location());
}

// Does what may fail; where somebody collects mistakes, it is noted, and left undone.
template <class Work>
void noting(Diagnostics* problems, const Work& work) {
  if (problems == nullptr) return work();
  try {
    work();
  } catch (const Error& error) {
    problems->error(error.code(), "", error.message(), error.remedy());
  }
}

/// Loads files with their includes; knows which files are open now (cycles) and how many were read.
class Loader {
 public:
  /// `problems`: where mistakes of includes go instead of being thrown; null: nowhere.
  explicit Loader(Diagnostics* problems = nullptr) : problems_(problems) {}

  ConfigNode load(const std::string& path) {
    std::error_code unknown;
    fs::path identity = fs::weakly_canonical(path, unknown);
    if (unknown) identity = fs::path(path).lexically_normal();
    open_.push_back({identity.string(), path});
    ConfigNode composed = with_includes(parse_config_file(path));
    open_.pop_back();
    return composed;
  }

  ConfigNode with_includes(const ConfigNode& local) {
    if (!local.is_map()) {
      fail("config.value.type", local.location(), "expected a map of sections at the top, got " + kind_text(local));
    }
    ConfigNode composed = ConfigNode::make_map({}, local.location());
    if (const ConfigNode* include = local.find("include")) {
      for (const ConfigNode& item : include->is_list() ? include->items() : std::vector<ConfigNode>{*include}) {
        const std::size_t open = open_.size();
        noting(problems_, [&] { merge_into(composed, load_included(item)); });
        open_.resize(open);
      }
    }
    merge_into(composed, local.without("include"));
    return composed;
  }

 private:
  struct OpenFile {
    std::string identity;  // canonical path
    std::string shown;     // path for messages
  };

  ConfigNode load_included(const ConfigNode& item) {
    if (!item.is_scalar())
      fail("config.include.file", item.location(), "include: expected a file name, got " + kind_text(item));
    const fs::path written(item.text());
    fs::path path =
        written.is_absolute() ? written : (fs::path(item.location().file).parent_path() / written).lexically_normal();
    std::error_code unknown;
    if (!is_there(path) || is_folder(path)) {
      const std::string shipped = shipped_config(item.text());
      if (shipped.empty()) {
        const std::string place = shipped_place(item.text());
        std::string near = near_config(item.text(), path.string());
        if (!near.empty() && !near.ends_with(".yaml")) near += ".yaml";  // which an include has to write
        if (near == item.text()) near.clear();                           // a folder of that name
        noting(problems_, [&] {
          fail("config.include.file", item.location(),
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
    const std::string identity = fs::weakly_canonical(path, unknown).string();
    const auto first =
        std::find_if(open_.begin(), open_.end(), [&](const OpenFile& f) { return f.identity == identity; });
    if (first != open_.end()) {
      std::string chain;
      for (auto file = first; file != open_.end(); ++file) chain += file->shown + " -> ";
      fail("config.include.cycle", item.location(),
           "include: '" + item.text() + "' includes itself: " + chain + first->shown);
    }
    if (open_.size() >= kMaxIncludeDepth || ++included_ > kMaxIncludedFiles) {
      fail("config.include.limit", item.location(),
           "include: more than " + std::to_string(kMaxIncludedFiles) + " files or " + std::to_string(kMaxIncludeDepth) +
               " levels");
    }
    return load(path.string());
  }

  Diagnostics* problems_;
  std::vector<OpenFile> open_;
  int included_ = 0;
};

std::string joined(const std::vector<std::string>& segments, std::size_t count) {
  return join(std::vector<std::string>(segments.begin(), segments.begin() + static_cast<std::ptrdiff_t>(count)), ".");
}

// The item that a segment of a key names, by index or by item_key.
std::size_t item_of(const ConfigNode& list, const std::string& segment, const std::string& key,
                    const Location& origin) {
  if (const auto index = to_number<std::size_t>(segment); index && *index < list.items().size()) return *index;
  std::vector<std::string> names;
  for (std::size_t i = 0; i < list.items().size(); ++i) {
    const std::string name = item_key(list, i);
    if (name == segment) return i;
    if (name != std::to_string(i)) names.push_back(name);
  }
  const std::string range = list.items().empty() ? "it is empty" : "0 to " + std::to_string(list.items().size() - 1);
  const std::string expected =
      names.empty() ? "an item's index, " + range : "an item's name (" + join(names) + ") or its index (" + range + ")";
  fail("config.set.key", origin,
       key + " is a list (" + list.location().text() + "): expected " + expected + ", got '" + segment + "'",
       near_name_remedy(segment, names));
}

/// Sets the value at segments[at...] of `node`; `origin` is the override for messages.
void set_at(ConfigNode& node, const std::vector<std::string>& segments, std::size_t at, const ConfigNode& value,
            const Location& origin) {
  if (at == segments.size()) return merge_into(node, value);
  const std::string& segment = segments[at];
  if (node.is_list()) {
    const std::size_t index = item_of(node, segment, "'" + joined(segments, at) + "'", origin);
    return set_at(node.items()[index], segments, at + 1, value, origin);
  }
  if (node.is_scalar()) {
    fail("config.set.key", origin,
         "'" + joined(segments, at) + "' is " + kind_text(node) + " (" + node.location().text() + "), it has no key '" +
             segment + "'");
  }
  const ConfigNode* const old_child = node.find(segment);
  ConfigNode child = old_child != nullptr ? *old_child : ConfigNode::make_null(origin);
  set_at(child, segments, at + 1, value, origin);
  // The override is a map of one key at this level: the rule of merging, with its type change, is then the same.
  ConfigNode over = ConfigNode::make_map({{segment, child}}, origin);
  if (!node.is_null() && !type_changes(node, over)) return node.set(segment, std::move(child));
  over.set_key_location(node.key_location());
  node = std::move(over);
}

void apply_override(ConfigNode& root, const ConfigOverride& over) {
  const Location& origin = over.value.location();
  std::vector<std::string> segments;
  for (std::size_t begin = 0; begin <= over.key.size();) {
    const std::size_t end = std::min(over.key.find('.', begin), over.key.size());
    segments.push_back(over.key.substr(begin, end - begin));
    if (segments.back().empty())
      fail("config.set.key", origin, "empty key in '" + over.key + "'",
           "write sections and keys with dots between: train.steps");
    begin = end + 1;
  }
  if (segments.size() > 32) fail("config.set.key", origin, "key path longer than 32 levels");
  if (segments[0] == "include")
    fail("config.set.key", origin, "include: files are included by a config, not by an override");
  set_at(root, segments, 0, over.value, origin);
}

ConfigOverride override_of(const ConfigOverride& node) { return node; }
ConfigOverride override_of(const std::string& text) {
  const std::size_t equals = text.find('=');
  // "--threads runtime.threads=2" was typed as "--threads 2".
  const std::size_t key = text.starts_with("--") ? text.find(' ') + 1 : 0;
  const std::string origin = key > 0 ? text.substr(0, key) + text.substr(equals + 1) : "--set " + text;
  if (equals == std::string::npos)
    fail("config.set.format", {origin, 0, 0}, "expected KEY=VALUE", "for example --set train.steps=1000");
  return {text.substr(key, equals - key), parse_config_value(std::string_view(text).substr(equals + 1), origin)};
}

// The list `passes`; none where there is none.
std::vector<ConfigNode>* passes_of(ConfigNode& root) {
  ConfigNode* const passes = root.find("passes");
  return passes != nullptr && passes->is_list() ? &passes->items() : nullptr;
}

// Every pass has a name, by which overrides can call it.
void name_passes(ConfigNode& root) {
  std::vector<ConfigNode>* const passes = passes_of(root);
  for (std::size_t i = 0; passes != nullptr && i < passes->size(); ++i) {
    ConfigNode& pass = (*passes)[i];
    if (pass.is_map() && pass.find("name") == nullptr)
      pass.set("name", ConfigNode::make_scalar(usual_pass_name(i), false, {}));
  }
}

/// Items of `passes` with `like: NAME`, each merged onto the earlier item of that name.
void resolve_like(ConfigNode& root) {
  std::vector<ConfigNode>* const passes = passes_of(root);
  std::vector<std::string> names;
  for (std::size_t i = 0; passes != nullptr && i < passes->size(); ++i) {
    ConfigNode& pass = (*passes)[i];
    const ConfigNode* name = pass.find("name");
    const std::string own_name = name != nullptr ? name->text() : std::string();
    if (const ConfigNode* like = pass.find("like")) {
      if (!like->is_scalar())
        fail("config.value.type", like->location(),
             "like: expected the name of an earlier pass, got " + kind_text(*like));
      const auto known = std::find(names.rbegin(), names.rend(), like->text());
      if (known == names.rend()) {
        std::vector<std::string> given;
        std::copy_if(names.begin(), names.end(), std::back_inserter(given),
                     [](const std::string& n) { return !n.empty(); });
        fail("config.pass.like", like->location(),
             "like: no earlier pass named '" + like->text() + "'" +
                 (given.empty() ? "; this is the first one with a name" : "; known: " + join(given)),
             near_name_remedy(like->text(), given));
      }
      pass = merge_config((*passes)[static_cast<std::size_t>(names.rend() - known) - 1], pass.without("like"));
    }
    names.push_back(own_name);
  }
}

template <class Override>
ConfigNode with_overrides(ConfigNode root, const std::vector<Override>& overrides, Diagnostics* problems = nullptr) {
  for (const Override& over : overrides) {
    noting(problems, [&] {
      name_passes(root);
      apply_override(root, override_of(over));
    });
  }
  name_passes(root);
  resolve_like(root);
  return root;
}

// The scalar of an item that tells it from the others; null: none does.
const ConfigNode* telling(const ConfigNode& item) {
  for (const char* key : {"name", "labels"}) {
    const ConfigNode* value = item.find(key);
    if (value != nullptr && value->is_scalar()) return value;
  }
  return nullptr;
}

}  // namespace

std::string item_key(const ConfigNode& list, std::size_t index) {
  const ConfigNode* own = telling(list.items()[index]);
  const auto is_letter = [](char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_'; };
  const auto is_plain = [&](char c) { return is_letter(c) || (c >= '0' && c <= '9') || c == '-'; };
  if (own == nullptr || own->text().empty() || !is_letter(own->text().front()) ||
      !std::all_of(own->text().begin(), own->text().end(), is_plain))
    return std::to_string(index);
  for (std::size_t i = 0; i < list.items().size(); ++i) {
    const ConfigNode* other = telling(list.items()[i]);
    if (i != index && other != nullptr && other->text() == own->text()) return std::to_string(index);
  }
  return own->text();
}

std::string usual_pass_name(std::size_t index) { return index == 0 ? "main" : "pass" + std::to_string(index); }

ConfigNode merge_config(ConfigNode base, const ConfigNode& over) {
  merge_into(base, over);
  return base;
}

ConfigNode compose_config(const std::string& path, const std::vector<std::string>& overrides, Diagnostics* problems) {
  return with_overrides(Loader(problems).load(find_config(path)), overrides, problems);
}

ConfigNode compose_config_with(const std::string& path, const std::vector<ConfigOverride>& overrides) {
  return with_overrides(Loader().load(find_config(path)), overrides);
}

ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<ConfigOverride>& overrides) {
  return with_overrides(Loader().with_includes(tree), overrides);
}

ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<std::string>& overrides) {
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
