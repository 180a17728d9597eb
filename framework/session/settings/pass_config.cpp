#include "session/settings/pass_config.h"

#include <algorithm>
#include <array>

#include "config/compose.h"

namespace semfield {

void describe(ParamVisitor& visit, BranchRules& p) {
  SEMFIELD_PARAM(visit, p, reads_feature,
                 "the branch reads the field's feature as well as the position; no gradient goes back into the field");
  SEMFIELD_PARAM(
      visit, p, least_weight,
      "samples of a smaller compositing weight are left out; this changes a logit by at most the sum of their "
      "weights times the largest logit of a sample",
      {0, 0.1});
  SEMFIELD_PARAM(visit, p, dropout, "share of the branch's feature set to 0 in a training step [Srivastava14]",
                 {0, 0.9});
  SEMFIELD_PARAM(visit, p, learning_rate, "learning rate of branch and head, as a factor of train.adam.learning_rate",
                 {0, 1e3});
  SEMFIELD_PARAM(visit, p, weight_decay,
                 "weight decay of branch and head: a step subtracts the learning rate times this share of a "
                 "value [Loshchilov19]",
                 {0, 10});
}

void describe(ParamVisitor& visit, SemanticBranchConfig& branch) {
  SEMFIELD_PARAM(
      visit, branch, labels,
      "in a list, the labels that this branch is for; noisy: neighbouring labels often differ; few: fewer than one "
      "training pixel in 500 has a label; dense: half of them or more have one; many: all others, and dense ones "
      "where no earlier branch is for them; any: every kind");
  describe(visit, branch.rules);
}

PluginSlot read_slot(PluginKind kind, const ConfigNode& node, const std::string& path, const Registry& registry,
                     Diagnostics& diagnostics, const std::vector<std::string>& other_keys) {
  PluginSlot slot;
  if (!node.is_map()) {
    diagnostics.error("config.value.type", node.location().text(),
                      path + ": expected a map with 'type', one of " + join(registry.names(kind)), {});
    return slot;
  }
  const ConfigNode* type = node.find("type");
  if (type == nullptr || !type->is_scalar()) {
    diagnostics.error("config.key.missing", node.location().text(), path + ": key 'type' is missing",
                      "choose one of " + join(registry.names(kind)));
    return slot;
  }
  try {
    slot.entry = &registry.get(kind, type->text());
  } catch (const Error& error) {
    diagnostics.error(error.code(), type->location().text(), error.message(), error.remedy());
    return slot;
  }
  slot.params = slot.entry->new_params();
  std::vector<std::string> allowed = other_keys;
  allowed.push_back("type");
  const int errors = diagnostics.error_count();
  read_params(
      node, path, [&](ParamVisitor& visit) { slot.params->describe(visit); }, diagnostics, allowed);
  if (diagnostics.error_count() == errors) {
    Diagnostics relations;
    slot.params->validate(relations);
    for (const Diagnostic& finding : relations.all()) {
      const std::string message = path + (finding.where.empty() ? "" : "." + finding.where) + ": " + finding.message;
      if (finding.severity == Severity::error) {
        diagnostics.error(finding.code, node.location().text(), message, finding.remedy);
      } else {
        diagnostics.warning(finding.code, node.location().text(), message, finding.remedy);
      }
    }
  }
  return slot;
}

bool read_branch_slots(const ConfigNode& node, const std::string& path, const Registry& registry, PluginSlot& position,
                       PluginSlot& field, Diagnostics& diagnostics) {
  if (!node.is_map()) {
    diagnostics.error("config.value.type", node.location().text(), path + ": expected a map {position, field, ...}",
                      {});
    return false;
  }
  const auto slot = [&](const char* key, PluginKind kind, PluginSlot& out) {
    const ConfigNode* plugin = node.find(key);
    if (plugin == nullptr || plugin->is_null()) {
      diagnostics.error("config.key.missing", node.location().text(), path + ": key '" + key + "' is missing", {});
      return;
    }
    out = read_slot(kind, *plugin, path + "." + key, registry, diagnostics);
  };
  slot("position", PluginKind::encoder, position);
  slot("field", PluginKind::field, field);
  return true;
}

namespace {

// {position, field} and the branch's own parameters.
SemanticBranchConfig read_branch(const ConfigNode& node, const std::string& path, const Registry& registry,
                                 Diagnostics& diagnostics) {
  SemanticBranchConfig branch;
  if (read_branch_slots(node, path, registry, branch.position, branch.field, diagnostics))
    read_params(node, path, [&](ParamVisitor& visit) { describe(visit, branch); }, diagnostics, {"position", "field"});
  return branch;
}

// One branch, or several from which the labels choose: one of them must take labels of any kind.
std::vector<SemanticBranchConfig> read_branches(const ConfigNode& node, const std::string& path,
                                                const Registry& registry, Diagnostics& diagnostics) {
  std::vector<SemanticBranchConfig> branches;
  if (!node.is_list()) {
    branches.push_back(read_branch(node, path, registry, diagnostics));
    return branches;
  }
  std::array<bool, ChoiceNames<LabelKind>::names.size()> served{};
  constexpr auto kMany = static_cast<std::size_t>(LabelKind::many);
  for (const ConfigNode& item : node.items()) {
    branches.push_back(read_branch(item, path + "." + item_key(node, branches.size()), registry, diagnostics));
    branches.back().key = "semantic." + item_key(node, branches.size() - 1);
    bool& known = served[static_cast<std::size_t>(branches.back().labels)];
    if (known || served[0] || (branches.back().labels == LabelKind::dense && served[kMany]))
      diagnostics.error("config.branch.unreached", item.location().text(),
                        path + ": an earlier branch takes all labels that this one is for", {});
    known = true;
  }
  for (std::size_t kind = 1; kind < served.size() && !served[0]; ++kind) {
    const bool among_many = kind == static_cast<std::size_t>(LabelKind::dense) && served[kMany];
    if (!served[kind] && !among_many)
      diagnostics.error("config.branch.missing", node.location().text(),
                        path + ": no branch is for labels: " + std::string(ChoiceNames<LabelKind>::names[kind]),
                        "add one, or let the last one be for labels: any");
  }
  return branches;
}

}  // namespace

void read_passes(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics) {
  const ConfigNode* list = tree.find("passes");
  if (list == nullptr || !list->is_list() || list->items().empty()) {
    const Location& where = list == nullptr ? tree.location() : list->location();
    diagnostics.error("config.value.type", where.text(),
                      "passes: expected a list of at least one pass {name, sampler, position, direction, field}", {});
    return;
  }
  static const std::vector<std::string> kKeys{"name", "like", "sampler", "position", "direction", "field", "semantic"};
  for (std::size_t index = 0; index < list->items().size(); ++index) {
    const ConfigNode& item = list->items()[index];
    const std::string path = "passes." + item_key(*list, index);
    PassConfig pass;
    pass.key = path;
    if (!item.is_map()) {
      diagnostics.error("config.value.type", item.location().text(),
                        path + ": expected a map {name, sampler, position, direction, field}", {});
      continue;
    }
    for (const auto& [key, value] : item.entries()) {
      if (std::find(kKeys.begin(), kKeys.end(), key) != kKeys.end()) continue;
      const std::string near = did_you_mean(key, kKeys);
      diagnostics.error("config.key.unknown", value.key_location().text(), path + ": unknown key '" + key + "'",
                        near.empty() ? "known: " + join(kKeys) : "did you mean '" + near + "'?");
    }
    pass.name = read_text(item, path, "name", usual_pass_name(index), diagnostics);
    const auto slot = [&](const char* key, PluginKind kind, PluginSlot& out, bool required) {
      const ConfigNode* node = item.find(key);
      if (node == nullptr || node->is_null()) {
        if (required)
          diagnostics.error("config.key.missing", item.location().text(), path + ": key '" + key + "' is missing", {});
        return;
      }
      out = read_slot(kind, *node, path + "." + key, registry, diagnostics);
    };
    slot("sampler", PluginKind::sampler, pass.sampler, true);
    slot("position", PluginKind::encoder, pass.position, true);
    slot("direction", PluginKind::encoder, pass.direction, false);
    slot("field", PluginKind::field, pass.field, true);
    if (const ConfigNode* branch = item.find("semantic"); branch != nullptr && !branch->is_null())
      pass.semantic = read_branches(*branch, path + ".semantic", registry, diagnostics);
    for (const PassConfig& other : config.passes) {
      if (other.name == pass.name)
        diagnostics.error("config.pass.twice", item.location().text(),
                          path + ": name '" + pass.name + "' is taken by an earlier pass", {});
    }
    config.passes.push_back(std::move(pass));
  }
}

ConfigNode typed_config(const std::string& type, const Describe& describe) {
  const ConfigNode params = params_to_config(describe);
  std::vector<ConfigNode::Entry> entries{{"type", ConfigNode::make_scalar(type, false, {})}};
  entries.insert(entries.end(), params.entries().begin(), params.entries().end());
  return ConfigNode::make_map(std::move(entries), {});
}

ConfigNode slot_config(const PluginSlot& slot) {
  return typed_config(slot.entry->name, [&](ParamVisitor& visit) { slot.params->describe(visit); });
}

ConfigNode pass_config(const PassConfig& pass) {
  ConfigNode node = ConfigNode::make_map({{"name", ConfigNode::make_scalar(pass.name, true, {})}}, {});
  node = node.with("sampler", slot_config(pass.sampler)).with("position", slot_config(pass.position));
  if (pass.direction.entry != nullptr) node = node.with("direction", slot_config(pass.direction));
  node = node.with("field", slot_config(pass.field));
  std::vector<ConfigNode> branches;
  for (const SemanticBranchConfig& branch : pass.semantic) {
    // describe() takes a mutable struct; the writer only looks.
    auto& editable = const_cast<SemanticBranchConfig&>(branch);
    const ConfigNode own = params_to_config([&](ParamVisitor& visit) { describe(visit, editable); });
    branches.push_back(own.with("position", slot_config(branch.position)).with("field", slot_config(branch.field)));
  }
  if (branches.empty()) return node;
  return node.with("semantic",
                   branches.size() == 1 ? branches.front() : ConfigNode::make_list(std::move(branches), {}));
}

}  // namespace semfield
