#include "session/settings/label_config.h"

#include <algorithm>
#include <filesystem>

#include "config/compose.h"
#include "labels/clicks/click_log.h"
#include "session/settings/pass_config.h"

namespace semfield {

namespace {

// Parameters of label readers that are paths.
constexpr const char* kPathKeys[] = {"folder", "file", "classes"};

ConfigNode step_config(const std::string& type, LabelStep& step) {
  return typed_config(type, [&](ParamVisitor& visit) { step.describe(visit); });
}

// Whether a path has to be made absolute; --set is always written in the working folder.
bool starts_elsewhere(const ConfigNode* value, bool paths_are_absolute) {
  if (value == nullptr || !value->is_scalar() || value->text().empty()) return false;
  return !paths_are_absolute || value->location().line <= 0;
}

}  // namespace

void read_label_steps(const ConfigNode& labels, bool paths_are_absolute, const Registry& registry, LabelConfig& config,
                      Diagnostics& diagnostics) {
  if (const ConfigNode* from = labels.find("from"); from != nullptr && !from->is_null()) {
    ConfigNode anchored = *from;
    for (const char* key : kPathKeys) {
      const ConfigNode* value = from->is_map() ? from->find(key) : nullptr;
      if (!starts_elsewhere(value, paths_are_absolute)) continue;
      anchored = anchored.with(key, ConfigNode::make_scalar(resolve_path(*value), true, value->location()));
    }
    const int errors = diagnostics.error_count();
    const PluginSlot slot = read_slot(PluginKind::label_reader, anchored, "scene.labels.from", registry, diagnostics);
    if (diagnostics.error_count() == errors) config.from = {slot.entry->name, slot.entry->label_reader(*slot.params)};
  }
  const ConfigNode* list = labels.find("degrade");
  if (list == nullptr || list->is_null()) return;
  if (!list->is_list()) {
    diagnostics.error(
        "config.value.type", list->location().text(), "scene.labels.degrade: expected a list of steps {type, ...}",
        "write degrade: [{type: TYPE, ...}], TYPE one of " + join(registry.names(PluginKind::degradation)));
    return;
  }
  for (const ConfigNode& item : list->items()) {
    const std::string path = "scene.labels.degrade." + std::to_string(config.degrade.size());
    const int errors = diagnostics.error_count();
    const PluginSlot slot = read_slot(PluginKind::degradation, item, path, registry, diagnostics);
    if (diagnostics.error_count() == errors)
      config.degrade.push_back({slot.entry->name, slot.entry->degradation(*slot.params)});
  }
}

void anchor_click_file(const ConfigNode& labels, bool of_a_run, LabelConfig& config) {
  namespace fs = std::filesystem;
  const ConfigNode* value = labels.find("clicks");
  if (value == nullptr || !value->is_scalar() || value->text().empty()) return;
  if (starts_elsewhere(value, of_a_run)) {
    config.selection.clicks = resolve_path(*value);
    return;
  }
  std::error_code unknown;
  if (!fs::is_regular_file(value->location().file, unknown)) return;  // a text that is no file of a run yet
  const fs::path folder = fs::absolute(value->location().file).parent_path().lexically_normal(), file = value->text();
  config.run_dir = folder.string();
  if (file.is_absolute() && file.filename() == kClickFile && fs::exists(folder / kClickFile, unknown))
    config.selection.clicks = kClickFile;
}

ConfigNode with_label_steps(const ConfigNode& labels, const LabelConfig& config) {
  ConfigNode out = labels;
  if (config.from.reader) out = out.with("from", step_config(config.from.type, *config.from.reader));
  if (config.degrade.empty()) return out;
  std::vector<ConfigNode> steps;
  for (const LabelConfig::Step& step : config.degrade) steps.push_back(step_config(step.type, *step.degradation));
  return out.with("degrade", ConfigNode::make_list(std::move(steps), {}));
}

}  // namespace semfield
