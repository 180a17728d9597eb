// Class tables with rules: reading and applying.
#include "datasets/obj_room/class_rules.h"

#include <filesystem>
#include <map>
#include <tuple>

#include "config/config_tree.h"

namespace semfield {
namespace {

std::vector<std::string> class_names(const ClassTable& table) {
  std::vector<std::string> names;
  for (const ClassEntry& e : table.entries()) names.push_back(e.name);
  return names;
}

const ClassEntry* find_class(const ClassTable& table, const std::string& name) {
  for (const ClassEntry& e : table.entries()) {
    if (e.name == name) return &e;
  }
  return nullptr;
}

void read_rule(const ConfigNode& node, ClassRules& out, Diagnostics& diagnostics) {
  const std::string where = node.location().text();
  if (!node.is_map()) {
    diagnostics.error("classes.rule.format", where, "a rule is a map such as {object: \"chair_*\", class: chair}", {});
    return;
  }
  ClassRule rule;
  bool has_class = false;
  for (const auto& [key, value] : node.entries()) {
    if (key == "object") {
      rule.object = value.text();
    } else if (key == "group") {
      rule.group = value.text();
    } else if (key == "material") {
      rule.material = value.text();
    } else if (key == "class") {
      has_class = true;
      const ClassEntry* entry = find_class(out.table, value.text());
      if (entry == nullptr) {
        const std::string near = did_you_mean(value.text(), class_names(out.table));
        diagnostics.error("labels.class.unknown", value.location().text(), "no class named '" + value.text() + "'",
                          near.empty() ? "" : "did you mean '" + near + "'?");
      } else {
        rule.id = entry->id;
      }
    } else {
      const std::string near = did_you_mean(key, {"object", "group", "material", "class"});
      diagnostics.error("config.key.unknown", value.location().text(), "unknown key '" + key + "' in a rule",
                        near.empty() ? "known: object, group, material, class" : "did you mean '" + near + "'?");
    }
  }
  if (!has_class) diagnostics.error("classes.rule.format", where, "the rule names no class", "add class: NAME");
  if (rule.object.empty() && rule.group.empty() && rule.material.empty()) {
    diagnostics.error("classes.rule.format", where, "the rule asks for no object, group or material",
                      "add object: \"PATTERN\"");
  }
  out.rules.push_back(rule);
}

// "chair__Mesh037_Wood" -> "chair"; "dining_chair_2" -> "dining_chair"; "Chair.004" -> "Chair".
std::string stem_of(const std::string& name) {
  const auto cut = name.find("__");
  if (cut != std::string::npos) return name.substr(0, cut);
  const auto end = name.find_last_not_of("0123456789");
  if (end == std::string::npos || end + 1 == name.size() || (name[end] != '_' && name[end] != '.')) return name;
  return name.substr(0, end);
}

}  // namespace

bool matches_glob(const std::string& text, const std::string& pattern) {
  std::size_t t = 0, p = 0, star = std::string::npos, retry = 0;
  while (t < text.size()) {
    if (p < pattern.size() && (pattern[p] == '?' || pattern[p] == text[t]) && pattern[p] != '*') {
      ++t;
      ++p;
    } else if (p < pattern.size() && pattern[p] == '*') {
      star = p++;
      retry = t;
    } else if (star != std::string::npos) {
      p = star + 1;
      t = ++retry;
    } else {
      return false;
    }
  }
  while (p < pattern.size() && pattern[p] == '*') ++p;
  return p == pattern.size();
}

ClassRules load_class_rules(const std::string& path) {
  ClassRules out;
  const std::string extension = std::filesystem::path(path).extension().string();
  if (extension == ".csv") {
    out.table = ClassTable::load(path);
    return out;
  }
  const ConfigNode root = parse_config_file(path);
  if (!root.is_map()) {
    out.table = ClassTable::load(path);
    return out;
  }
  Diagnostics diagnostics;
  for (const auto& [key, value] : root.entries()) {
    if (key != "classes" && key != "rules") {
      diagnostics.error("config.key.unknown", value.location().text(), "unknown key '" + key + "'",
                        "known: classes, rules");
    }
  }
  try {
    out.table = ClassTable::load(path);  // reads the list 'classes' of such a map
  } catch (const Error& e) {
    if (!diagnostics.has_errors()) throw;
    diagnostics.error(e.code(), "", e.message(), e.remedy());
  }
  if (const ConfigNode* rules = root.find("rules"); rules != nullptr && !out.table.empty()) {
    if (!rules->is_list())
      diagnostics.error("classes.rule.format", rules->location().text(), "'rules' is a list of rules", {});
    for (const ConfigNode& rule : rules->items()) read_rule(rule, out, diagnostics);
  }
  diagnostics.throw_if_errors(ErrorKind::config, "the class table '" + path + "' has errors");
  return out;
}

std::vector<std::int16_t> classes_of_mesh(const TriangleMesh& mesh, const ClassRules& rules, Diagnostics& diagnostics) {
  using Key = std::tuple<std::int32_t, std::int32_t, std::int32_t>;
  std::map<Key, std::int16_t> known;
  std::vector<bool> reported(mesh.objects.size(), false);
  std::vector<std::int16_t> out(mesh.size(), kVoid);
  const auto index_of = [&](std::int32_t id) { return static_cast<std::int16_t>(rules.table.index_of(id)); };
  for (std::size_t i = 0; i < mesh.size(); ++i) {
    const Key key{mesh.object_of[i], mesh.group_of[i], mesh.material_of[i]};
    const auto [it, fresh] = known.emplace(key, kVoid);
    if (fresh) {
      const std::string& object = mesh.objects[static_cast<std::size_t>(mesh.object_of[i])];
      const std::string& group = mesh.groups[static_cast<std::size_t>(mesh.group_of[i])];
      const std::string material =
          mesh.material_of[i] < 0 ? "" : mesh.materials[static_cast<std::size_t>(mesh.material_of[i])].name;
      bool found = false;
      for (const ClassRule& rule : rules.rules) {
        const auto fits = [](const std::string& pattern, const std::string& text) {
          return pattern.empty() || matches_glob(text, pattern);
        };
        if (!fits(rule.object, object) || !fits(rule.group, group) || !fits(rule.material, material)) continue;
        it->second = index_of(rule.id);
        found = true;
        break;
      }
      if (!found) {
        if (const ClassEntry* entry = find_class(rules.table, stem_of(object))) {
          it->second = index_of(entry->id);
          found = true;
        }
      }
      const auto o = static_cast<std::size_t>(mesh.object_of[i]);
      if (!found && !reported[o]) {
        reported[o] = true;
        diagnostics.error("classes.rule.missing", "object '" + object + "'",
                          "has no class" + (group.empty() ? "" : " (group '" + group + "')") +
                              (material.empty() ? "" : " (material '" + material + "')"),
                          "add a rule such as {object: \"" + object + "\", class: NAME} to the class table");
      }
    }
    out[i] = it->second;
  }
  return out;
}

}  // namespace semfield
