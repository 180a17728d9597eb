#include "session/trained_classes.h"

#include <fmt/format.h>

#include <charconv>
#include <cstdint>
#include <map>

#include "config/config_tree.h"
#include "core/error.h"

namespace semfield {

namespace {

constexpr const char* kIgnored = ", ignored";

// "'chair'" or "'void', ignored" by id.
std::map<std::int64_t, std::string> classes_by_id(const std::string& yaml) {
  std::map<std::int64_t, std::string> out;
  if (yaml.empty()) return out;
  ConfigNode list;
  try {
    list = parse_config_text(yaml, "checkpoint metadata 'classes'");
  } catch (const Error& error) {
    throw Error(ErrorKind::data, error.code(), error.message(),
                "resume from another checkpoint of the run: move this file out of the folder");
  }
  for (const ConfigNode& item : list.items()) {
    const ConfigNode *id = item.find("id"), *name = item.find("name"), *ignore = item.find("ignore");
    std::int64_t number = -1;
    if (id != nullptr) std::from_chars(id->text().data(), id->text().data() + id->text().size(), number);
    out[number] = fmt::format("'{}'{}", name == nullptr ? "" : name->text(),
                              ignore != nullptr && ignore->text() == "true" ? kIgnored : "");
  }
  return out;
}

}  // namespace

void require_class_table(const std::string& trained, const ClassTable& now, const std::optional<Annotations>& clicks) {
  const std::map<std::int64_t, std::string> before = classes_by_id(trained),
                                            after = classes_by_id(now.empty() ? std::string() : now.to_yaml());
  std::map<std::int64_t, std::string> all = before;
  all.insert(after.begin(), after.end());
  for (const auto& [id, name] : all) {
    const auto then = before.find(id), today = after.find(id);
    if (then != before.end() && today != after.end() && then->second == today->second) continue;
    const int index = now.index_of(static_cast<std::int32_t>(id));
    const bool was_valid = then != before.end() && !then->second.ends_with(kIgnored);
    if (clicks && was_valid && index >= clicks->own_classes() && index < clicks->named_classes()) continue;
    const bool lost = clicks && was_valid && (index >= clicks->named_classes() || today == after.end());
    const auto said = [](const auto& found, const auto& end) {
      return found == end ? "not in the table" : found->second;
    };
    throw Error(
        ErrorKind::data, "checkpoint.classes.changed",
        fmt::format("the scene's class table is not the one that the run was trained with: class {} was {}, and "
                    "is {} now",
                    id, said(then, before.end()), said(today, after.end())),
        lost ? "give the file of clicks that named it: --set scene.labels.clicks=FILE"
             : "restore the table (the run folder's classes.yaml is that of training), or train again with --out");
  }
}

}  // namespace semfield
