// Keys from the declarations of sections, steps of labels, losses and plugins.
#include "tests/docs/keys.h"

#include "plugin/linked_plugins.h"
#include "settings/run_config.h"

namespace semfield::docs {
namespace {

std::vector<ParamDoc> params_of(const PluginEntry& entry) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  return describe_params([&](ParamVisitor& visit) { params->describe(visit); });
}

}  // namespace

Keys::Keys() {
  for (const SectionDoc& section : describe_sections()) add(section.path, section.params);
  // By convention every dataset of files has these.
  for (const char* key : {"train.schedule.legs", "scene.root", "scene.file", "scene.classes", "scene.type",
                          "scene.unknown_labels", "passes.N"})
    keys_.insert(key);
  register_linked_plugins(registry_);
  for (const PluginEntry* entry : registry_.entries()) {
    const std::vector<ParamDoc> params = params_of(*entry);
    if (entry->kind == PluginKind::dataset) {
      for (const ParamDoc& doc : params) datasets_[entry->name].insert("scene." + doc.name);
      continue;
    }
    if (entry->kind == PluginKind::loss) {
      add("losses.N", params);
      continue;
    }
    if (entry->kind == PluginKind::head) {
      add("heads.N", params);
      continue;
    }
    if (entry->kind == PluginKind::label_reader || entry->kind == PluginKind::degradation) {
      add(entry->kind == PluginKind::degradation ? "scene.labels.degrade.N" : "scene.labels.from", params);
      continue;
    }
    for (const char* slot : {"sampler", "position", "direction", "field", "semantic.position", "semantic.field"})
      add("passes.N." + std::string(slot), params);
    for (const char* slot : {"position", "field"}) add("heads.N.branch." + std::string(slot), params);
  }
}

bool Keys::known(const std::string& key, const std::string& dataset) const {
  const auto own = datasets_.find(dataset);
  return keys_.contains(key) || (own != datasets_.end() && own->second.contains(key));
}

bool Keys::known_somewhere(const std::string& key) const {
  for (const auto& [dataset, own] : datasets_)
    if (known(key, dataset)) return true;
  return false;
}

std::set<std::string> Keys::bare() const {
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

void Keys::add(const std::string& path, const std::vector<ParamDoc>& params) {
  for (std::size_t dot = path.find('.'); dot != std::string::npos; dot = path.find('.', dot + 1))
    keys_.insert(path.substr(0, dot));
  keys_.insert(path);
  for (const ParamDoc& doc : params) keys_.insert(path + "." + doc.name);
}

}  // namespace semfield::docs
