#include "config/config_words.h"

#include <algorithm>
#include <iterator>
#include <string_view>
#include <system_error>
#include <unordered_map>
#include <utility>

#include "config/explain.h"
#include "core/files.h"
#include "core/text.h"

namespace semfield {

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

namespace {

// Whether both have a scalar `type`, and they differ.
bool type_changes(const ConfigNode& base, const ConfigNode& over) {
  const ConfigNode *old_type = base.find("type"), *new_type = over.find("type");
  return old_type != nullptr && old_type->is_scalar() && new_type != nullptr && new_type->is_scalar() &&
         old_type->text() != new_type->text();
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
  refuse_at("config.set.key", origin,
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
    refuse_at("config.set.key", origin,
              "'" + joined(segments, at) + "' is " + kind_text(node) + " (" + node.location().text() +
                  "), it has no key '" + segment + "'");
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
  const std::vector<std::string_view> parts = parts_of(over.key, '.');
  const std::vector<std::string> segments(parts.begin(), parts.end());
  if (std::find(parts.begin(), parts.end(), "") != parts.end())
    refuse_at("config.set.key", origin, "empty key in '" + over.key + "'",
              "write sections and keys with dots between: train.steps");
  if (segments.size() > 32) refuse_at("config.set.key", origin, "key path longer than 32 levels");
  if (segments[0] == "include")
    refuse_at("config.set.key", origin, "include: files are included by a config, not by an override");
  set_at(root, segments, 0, over.value, origin);
}

ConfigOverride parse_override(const std::string& text) {
  const std::size_t equals = text.find('=');
  // "--threads runtime.threads=2" was typed as "--threads 2".
  const std::size_t key = text.starts_with("--") ? text.find(' ') + 1 : 0;
  const std::string origin = key > 0 ? text.substr(0, key) + text.substr(equals + 1) : "--set " + text;
  if (equals == std::string::npos)
    refuse_at("config.set.format", {origin, 0, 0}, "expected KEY=VALUE", "for example --set train.steps=1000");
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
        refuse_at("config.value.type", like->location(),
                  "like: expected the name of an earlier pass, got " + kind_text(*like));
      const auto known = std::find(names.rbegin(), names.rend(), like->text());
      if (known == names.rend()) {
        std::vector<std::string> given;
        std::copy_if(names.begin(), names.end(), std::back_inserter(given),
                     [](const std::string& n) { return !n.empty(); });
        refuse_at("config.pass.like", like->location(),
                  "like: no earlier pass named '" + like->text() + "'" +
                      (given.empty() ? "; this is the first one with a name" : "; known: " + join(given)),
                  near_name_remedy(like->text(), given));
      }
      pass = merge_config((*passes)[static_cast<std::size_t>(names.rend() - known) - 1], pass.without("like"));
    }
    names.push_back(own_name);
  }
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

ConfigNode merge_config(ConfigNode base, const ConfigNode& over) {
  merge_into(base, over);
  return base;
}

std::string item_key(const ConfigNode& list, std::size_t index) {
  const ConfigNode* own = telling(list.items()[index]);
  const auto is_plain = [](char c) { return is_alnum(c) || c == '_' || c == '-'; };
  if (own == nullptr || own->text().empty() || is_digit(own->text()[0]) || own->text()[0] == '-' ||
      !std::all_of(own->text().begin(), own->text().end(), is_plain))
    return std::to_string(index);
  for (std::size_t i = 0; i < list.items().size(); ++i) {
    const ConfigNode* other = telling(list.items()[i]);
    if (i != index && other != nullptr && other->text() == own->text()) return std::to_string(index);
  }
  return own->text();
}

std::string usual_pass_name(std::size_t index) { return index == 0 ? "main" : "pass" + std::to_string(index); }

std::vector<ConfigOverride> parse_overrides(const std::vector<std::string>& texts, Diagnostics* problems) {
  std::vector<ConfigOverride> overrides;
  for (const std::string& text : texts) noting(problems, [&] { overrides.push_back(parse_override(text)); });
  return overrides;
}

void set_values(ConfigNode& root, const std::vector<ConfigOverride>& overrides, Diagnostics* problems) {
  for (const ConfigOverride& over : overrides) {
    noting(problems, [&] {
      name_passes(root);
      apply_override(root, over);
    });
  }
}

std::vector<ConfigOverride> overrides_of(const ConfigNode& map, const std::string& what) {
  if (!map.is_map())
    refuse_at("config.set.format", map.location(), what + ": expected a map of key paths",
              "write for example {train.steps: 500}");
  std::vector<ConfigOverride> overrides;
  for (const auto& [key, value] : map.entries()) overrides.push_back({key, value});
  return overrides;
}

ConfigNode with_overrides(ConfigNode root, const std::vector<ConfigOverride>& overrides, Diagnostics* problems) {
  set_values(root, overrides, problems);
  name_passes(root);
  resolve_like(root);
  return root;
}

}  // namespace semfield
