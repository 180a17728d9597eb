// Every key that a message names is one that `--set` takes.
#include <gtest/gtest.h>

#include <filesystem>
#include <map>
#include <regex>
#include <set>

#include "core/text.h"
#include "plugin/linked_plugins.h"
#include "settings/label_config.h"
#include "settings/loss_config.h"
#include "settings/run_config.h"
#include "system/files.h"

namespace semfield::docs {
namespace {

namespace fs = std::filesystem;

std::vector<ParamDoc> params_of(const PluginEntry& entry) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  return describe_params([&](ParamVisitor& visit) { params->describe(visit); });
}

// Keys as messages write them; an index of a list is N.
class Keys {
 public:
  Keys() {
    for (const SectionDoc& section : describe_sections()) add(section.path, section.params);
    for (const LabelStepDoc& step : describe_label_steps())
      add("scene.labels." + step.key + (step.key == "degrade" ? ".N" : ""), step.params);
    for (const LossDoc& term : describe_losses()) add("losses.N", term.params);
    // By convention every dataset of files has these.
    for (const char* key :
         {"scene.root", "scene.file", "scene.classes", "scene.type", "scene.unknown_labels", "passes.N"})
      keys_.insert(key);
    register_linked_plugins(registry_);
    for (const PluginEntry* entry : registry_.entries()) {
      const std::vector<ParamDoc> params = params_of(*entry);
      if (entry->kind == PluginKind::dataset) {
        for (const ParamDoc& doc : params) datasets_[entry->name].insert("scene." + doc.name);
        continue;
      }
      for (const char* slot : {"sampler", "position", "direction", "field", "semantic.position", "semantic.field"})
        add("passes.N." + std::string(slot), params);
    }
  }

  // `dataset`: whose sources name it; "": the framework's, which know none.
  bool known(const std::string& key, const std::string& dataset) const {
    const auto own = datasets_.find(dataset);
    return keys_.contains(key) || (own != datasets_.end() && own->second.contains(key));
  }

  // Last parts of keys that a message could name bare: "near_m" for "scene.load.near_m".
  std::set<std::string> bare() const {
    std::set<std::string> out;
    const auto take = [&](const std::string& key) {
      const std::string last = key.substr(key.rfind('.') + 1);
      if (key.starts_with("scene.") && last.find('_') != std::string::npos) out.insert(last);
    };
    for (const std::string& key : keys_) take(key);
    for (const auto& [name, keys] : datasets_)
      for (const std::string& key : keys) take(key);
    return out;
  }

 private:
  void add(const std::string& path, const std::vector<ParamDoc>& params) {
    for (std::size_t dot = path.find('.'); dot != std::string::npos; dot = path.find('.', dot + 1))
      keys_.insert(path.substr(0, dot));
    keys_.insert(path);
    for (const ParamDoc& doc : params) keys_.insert(path + "." + doc.name);
  }
  Registry registry_;
  std::set<std::string> keys_;
  std::map<std::string, std::set<std::string>> datasets_;
};

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
  static const std::regex setting(R"([a-z_0-9.]+=\S*)");  // of the program's own, not for a reader
  static const std::regex key(
      R"((^|[^a-zA-Z0-9_./<-])((?:scene|semantics|rendering|passes|train|runtime|report|fuse|propagate|limits|labels)\.[a-z_N0-9]+(?:\.[a-z_N0-9]+)*)(?![/a-z]))");
  static const std::regex index(R"(\.[0-9]+)");
  static const std::regex file(R"(.*\.(json|html|h|yaml|yml|csv|tsv|tfevents|sfpack|png|zip))");
  int seen = 0;
  for (const Literal& literal : literals()) {
    if (std::regex_match(literal.text, setting)) continue;
    for (std::sregex_iterator found(literal.text.begin(), literal.text.end(), key), end; found != end; ++found) {
      const std::string name = std::regex_replace((*found)[2].str(), index, ".N");
      if (std::regex_match(name, file)) continue;
      ++seen;
      EXPECT_TRUE(keys.known(name, literal.dataset)) << literal.place << ": no key '" << name << "': " << literal.text;
    }
  }
  EXPECT_GT(seen, 50) << "messages name keys";
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

}  // namespace
}  // namespace semfield::docs
