// Every key that a message or a page names is one that `--set` takes.
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <regex>
#include <set>

#include "config/params.h"
#include "core/text.h"
#include "plugin/loader.h"
#include "plugin/registry.h"
#include "session/settings/run_config.h"
#include "system/files.h"
#include "tests/docs/pages.h"

namespace semfield::docs {
namespace {

/// Every key that `--set` takes; an index of a list is N: "passes.N.sampler.samples".
class Keys {
 public:
  Keys() {
    for (const SchemaSection& section : describe_sections()) add(section.path, section.params);
    // By convention every dataset of files has these, or those that can say so.
    for (const char* key : {"train.schedule.legs", "scene.root", "scene.file", "scene.classes", "scene.type",
                            "scene.unknown_labels", "scene.masks", "scene.least_confidence", "passes.N"})
      keys_.insert(key);
    std::map<PluginKind, std::vector<std::string>> slots{{PluginKind::loss, {"losses.N"}},
                                                         {PluginKind::head, {"heads.N"}},
                                                         {PluginKind::grouping, {"objects.method"}},
                                                         {PluginKind::label_reader, {"scene.labels.from"}},
                                                         {PluginKind::degradation, {"scene.labels.degrade.N"}},
                                                         {PluginKind::sampler, {"passes.N.sampler"}}};
    slots[PluginKind::encoder] = {"passes.N.position", "passes.N.direction", "passes.N.semantic.position",
                                  "heads.N.branch.position"};
    slots[PluginKind::field] = {"passes.N.field", "passes.N.semantic.field", "heads.N.branch.field"};
    Registry registry;
    register_linked_plugins(registry);
    for (const PluginEntry* entry : registry.entries()) {
      const std::unique_ptr<PluginParams> own = entry->new_params();
      const std::vector<ParamDoc> params = describe_params([&](ParamVisitor& visit) { own->describe(visit); });
      for (const std::string& slot : slots[entry->kind]) add(slot, params);
      if (entry->kind != PluginKind::dataset) continue;
      for (const ParamDoc& doc : params) datasets_[entry->name].insert("scene." + doc.name);
    }
  }

  /// `dataset`: the one whose keys count besides the framework's; "": none.
  bool known(const std::string& key, const std::string& dataset) const {
    const auto own = datasets_.find(dataset);
    return keys_.contains(key) || (own != datasets_.end() && own->second.contains(key));
  }

  /// Whether the framework or any dataset has it.
  bool known_somewhere(const std::string& key) const {
    return keys_.contains(key) || std::any_of(datasets_.begin(), datasets_.end(),
                                              [&](const auto& dataset) { return dataset.second.contains(key); });
  }

  /// Last parts of keys of the scene that a message could name bare: "near_m" for "scene.load.near_m".
  std::set<std::string> bare() const {
    std::set<std::string> all = keys_, out;
    for (const auto& [name, keys] : datasets_) all.insert(keys.begin(), keys.end());
    for (const std::string& key : all) {
      const std::string last = key.substr(key.rfind('.') + 1);
      if (key.starts_with("scene.") && last.find('_') != std::string::npos) out.insert(last);
    }
    return out;
  }

 private:
  void add(const std::string& path, const std::vector<ParamDoc>& params) {
    for (std::size_t dot = path.find('.'); dot != std::string::npos; dot = path.find('.', dot + 1))
      keys_.insert(path.substr(0, dot));
    keys_.insert(path);
    for (const ParamDoc& doc : params) keys_.insert(path + "." + doc.name);
  }

  std::set<std::string> keys_;
  std::map<std::string, std::set<std::string>> datasets_;
};

namespace fs = std::filesystem;

// Codes look like keys; the build writes this page from the sources.
std::set<std::string> codes() {
  static const std::regex row(R"(\n\| `([a-z0-9_.]+)` \|)");
  const std::string text = page("docs/reference/codes.md");
  std::set<std::string> out;
  for (std::sregex_iterator found(text.begin(), text.end(), row), end; found != end; ++found) out.insert((*found)[1]);
  return out;
}

struct Literal {
  std::string place, dataset, text;
};

std::vector<Literal> literals() {
  static const std::regex quoted(R"re("((?:[^"\\]|\\.)*)")re");
  std::vector<Literal> out;
  for (const char* top : {"app", "framework", "plugins"}) {
    for (const auto& entry : fs::recursive_directory_iterator(fs::path(SEMFIELD_SOURCE_DIR) / top)) {
      const fs::path& path = entry.path();
      const std::string name = path.filename().string();
      if ((path.extension() != ".cpp" && path.extension() != ".h") || name.ends_with("_test.cpp") ||
          name.ends_with("_sample.cpp"))
        continue;
      // Paths of cameras are obj_room's.
      const std::string folder = path.parent_path().filename().string();
      const std::string dataset = name == "camera_path.cpp" ? "obj_room" : folder;
      const std::string text = read_text_file(path.string());
      std::string_view rest = text, line;
      for (int number = 1; next_line(rest, line); ++number) {
        const std::string source(line.substr(0, line.find("// ")));
        if (source.find("#include") != std::string::npos) continue;
        for (std::sregex_iterator found(source.begin(), source.end(), quoted), end; found != end; ++found)
          out.push_back({path.string() + ":" + std::to_string(number), dataset, (*found)[1]});
      }
    }
  }
  return out;
}

TEST(MessageKeys, EveryKeyIsOneThatSetTakes) {
  const Keys keys;
  const std::set<std::string> known_codes = codes();
  EXPECT_GT(known_codes.size(), 300u);
  for (const std::string& code : known_codes) EXPECT_FALSE(keys.known_somewhere(code)) << code << " is a key, too";
  static const std::regex setting(R"([a-z_0-9.]+=\S*)");  // of the program's own, not for a reader
  static const std::regex key(
      R"((^|[^a-zA-Z0-9_./<-])((?:scene|semantics|rendering|passes|train|runtime|report|fuse|propagate|limits|labels)\.[a-z_N0-9]+(?:\.[a-z_N0-9]+)*)(?![/a-z]))");
  static const std::regex index(R"(\.[0-9]+|\.main)");  // a pass by its number or its usual name
  static const std::regex file(R"(.*\.(json|html|h|yaml|yml|csv|tsv|tfevents|sfpack|png|zip))");
  int seen = 0;
  for (const Literal& literal : literals()) {
    if (std::regex_match(literal.text, setting) || known_codes.contains(literal.text)) continue;
    for (std::sregex_iterator found(literal.text.begin(), literal.text.end(), key), end; found != end; ++found) {
      const std::string name = std::regex_replace((*found)[2].str(), index, ".N");
      if (std::regex_match(name, file)) continue;
      ++seen;
      EXPECT_TRUE(keys.known(name, literal.dataset)) << literal.place << ": no key '" << name << "': " << literal.text;
    }
  }
  EXPECT_GT(seen, 50) << "messages name keys";
}

// scripts/docs_parts.py finds codes by what is before them: what looks like one of their areas is a code, a key or a
// file.
TEST(MessageKeys, EveryLiteralThatLooksLikeACodeIsListed) {
  const Keys keys;
  const std::set<std::string> known = codes();
  std::set<std::string> areas;
  for (const std::string& code : known) areas.insert(code.substr(0, code.find('.')));
  static const std::regex form(R"([a-z0-9_]+(\.[a-z0-9_]+){1,3})"), file(R"(.*\.(yaml|yml|csv|json|zip|ply|glb|npz))");
  for (const Literal& literal : literals()) {
    if (!std::regex_match(literal.text, form) || std::regex_match(literal.text, file)) continue;
    if (!areas.contains(literal.text.substr(0, literal.text.find('.'))) || known.contains(literal.text)) continue;
    EXPECT_TRUE(keys.known(literal.text, literal.dataset)) << literal.place << ": " << literal.text;
  }
}

TEST(MessageKeys, NoRemedyNamesAKeyOfTheSceneWithoutItsPath) {
  const std::set<std::string> bare = Keys().bare();
  static const std::regex advice(R"((?:set|give|raise|lower|drop|change|check) ([a-z]+(?:_[a-z]+)+)\b)");
  for (const Literal& literal : literals()) {
    std::smatch found;
    if (!std::regex_search(literal.text, found, advice)) continue;
    EXPECT_FALSE(bare.contains(found[1]))
        << literal.place << ": '" << found[1] << "' without its path: " << literal.text;
  }
}

// Code spans that begin with a section's name: `passes.0.sampler.samples`, `scene.split: paper`, `train.steps=2000`.
TEST(PageKeys, EveryKeyIsOneThatSetTakes) {
  const Keys keys;
  const std::set<std::string> known_codes = codes();
  static const std::regex span(
      R"(`((?:scene|semantics|rendering|passes|train|runtime|report|fuse|propagate|limits|losses)(?:\.[A-Za-z_N0-9]+)+)(?:[=:][^`]*)?`)");
  static const std::regex index(R"(\.[0-9]+(?=\.|$))"), name(R"(^passes\.[a-z_0-9]+)");
  static const std::regex file(R"(.*\.(json|html|h|cpp|yaml|md|csv|py|npz))");
  int seen = 0;
  for (const std::string& path : all_pages()) {
    if (path == "CHANGELOG.md" || path == "docs/decisions.md") continue;  // have keys of earlier versions
    const std::string text = page(path);
    for (std::sregex_iterator found(text.begin(), text.end(), span), end; found != end; ++found) {
      const std::string key = std::regex_replace(std::regex_replace((*found)[1].str(), index, ".N"), name, "passes.N");
      if (std::regex_match(key, file) || known_codes.contains(key)) continue;
      ++seen;
      EXPECT_TRUE(keys.known_somewhere(key)) << path << ": no key '" << key << "'";
    }
  }
  EXPECT_GT(seen, 100) << "pages name keys";
}

}  // namespace
}  // namespace semfield::docs
