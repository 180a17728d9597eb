#include "train/label_config.h"

#include <algorithm>

#include "config/compose.h"

namespace semfield {

namespace {

// Parameters of label readers that are paths.
constexpr const char* kPathKeys[] = {"folder", "file", "classes"};

template <class Step>
std::unique_ptr<Step> read_step(const ConfigNode& node, const std::string& path,
                                const std::vector<StepKind<Step>>& kinds, std::string& type_out,
                                Diagnostics& diagnostics) {
  std::vector<std::string> types;
  for (const StepKind<Step>& kind : kinds) types.emplace_back(kind.type);
  const ConfigNode* type = node.is_map() ? node.find("type") : nullptr;
  if (type == nullptr || !type->is_scalar()) {
    diagnostics.error(node.location().text(), path + ": expected a map with 'type', one of " + join(types));
    return nullptr;
  }
  const auto found = std::find(types.begin(), types.end(), type->text());
  if (found == types.end()) {
    const std::string near = did_you_mean(type->text(), types);
    diagnostics.error(type->location().text(), path + ": no type '" + type->text() + "'; known: " + join(types),
                      near.empty() ? "" : "did you mean '" + near + "'?");
    return nullptr;
  }
  std::unique_ptr<Step> step = kinds[static_cast<std::size_t>(found - types.begin())].make();
  const int errors = diagnostics.error_count();
  read_params(node, path, [&](ParamVisitor& visit) { step->describe(visit); }, diagnostics, {"type"});
  if (diagnostics.error_count() == errors) {
    Diagnostics relations;
    step->validate(relations);
    for (const Diagnostic& finding : relations.all()) {
      const std::string message = path + (finding.where.empty() ? "" : "." + finding.where) + ": " + finding.message;
      diagnostics.error(node.location().text(), message, finding.remedy);
    }
  }
  type_out = type->text();
  return step;
}

ConfigNode step_config(const std::string& type, LabelStep& step) {
  const ConfigNode params = params_to_config([&](ParamVisitor& visit) { step.describe(visit); });
  std::vector<ConfigNode::Entry> entries{{"type", ConfigNode::make_scalar(type, false, {})}};
  entries.insert(entries.end(), params.entries().begin(), params.entries().end());
  return ConfigNode::make_map(std::move(entries), {});
}

template <class Step>
void add_docs(const char* key, const std::vector<StepKind<Step>>& kinds, std::vector<LabelStepDoc>& docs) {
  for (const StepKind<Step>& kind : kinds) {
    const std::unique_ptr<Step> step = kind.make();
    docs.push_back({key, std::string(kind.type), std::string(kind.sentence),
                    describe_params([&](ParamVisitor& visit) { step->describe(visit); })});
  }
}

}  // namespace

void read_label_steps(const ConfigNode& labels, bool paths_are_absolute, LabelConfig& config,
                      Diagnostics& diagnostics) {
  if (const ConfigNode* from = labels.find("from"); from != nullptr && !from->is_null()) {
    ConfigNode anchored = *from;
    for (const char* key : kPathKeys) {
      const ConfigNode* value = from->is_map() ? from->find(key) : nullptr;
      if (value == nullptr || !value->is_scalar() || value->text().empty()) continue;
      if (paths_are_absolute && value->location().line > 0) continue;  // --set is written in the working folder
      anchored = anchored.with(key, ConfigNode::make_scalar(resolve_path(*value), true, value->location()));
    }
    config.from.reader = read_step(anchored, "scene.labels.from", label_reader_kinds(), config.from.type, diagnostics);
  }
  const ConfigNode* list = labels.find("degrade");
  if (list == nullptr || list->is_null()) return;
  if (!list->is_list()) {
    diagnostics.error(list->location().text(), "scene.labels.degrade: expected a list of steps {type, ...}",
                      "write degrade: [{type: pixel_noise, ratio: 0.5}]");
    return;
  }
  for (const ConfigNode& item : list->items()) {
    const std::string path = "scene.labels.degrade." + std::to_string(config.degrade.size());
    LabelConfig::Step step;
    step.degradation = read_step(item, path, degradation_kinds(), step.type, diagnostics);
    if (step.degradation) config.degrade.push_back(std::move(step));
  }
}

ConfigNode with_label_steps(const ConfigNode& labels, const LabelConfig& config) {
  ConfigNode out = labels;
  if (config.from.reader) out = out.with("from", step_config(config.from.type, *config.from.reader));
  if (config.degrade.empty()) return out;
  std::vector<ConfigNode> steps;
  for (const LabelConfig::Step& step : config.degrade) steps.push_back(step_config(step.type, *step.degradation));
  return out.with("degrade", ConfigNode::make_list(std::move(steps), {}));
}

std::vector<LabelStepDoc> describe_label_steps() {
  std::vector<LabelStepDoc> docs;
  add_docs("from", label_reader_kinds(), docs);
  add_docs("degrade", degradation_kinds(), docs);
  return docs;
}

}  // namespace semfield
