#include "session/settings/loss_config.h"

#include <fmt/format.h>

#include <algorithm>

#include "session/settings/pass_config.h"

namespace semfield {

std::vector<LossEntry> read_losses(const ConfigNode& tree, const Registry& registry, Diagnostics& diagnostics) {
  std::vector<LossEntry> entries;
  const ConfigNode* list = tree.find("losses");
  if (list == nullptr || list->is_null()) return entries;
  if (!list->is_list()) {
    diagnostics.error("config.value.type", list->location().text(), "losses: expected a list of terms {type, ...}",
                      "write losses: [{type: distortion, weight: 0.002}]");
    return entries;
  }
  for (std::size_t i = 0; i < list->items().size(); ++i) {
    const ConfigNode& item = list->items()[i];
    const std::string path = "losses." + std::to_string(i);
    const int errors = diagnostics.error_count();
    PluginSlot slot = read_slot(PluginKind::loss, item, path, registry, diagnostics);
    if (diagnostics.error_count() > errors) continue;
    LossEntry entry{slot.entry->name, slot.entry->loss(*slot.params), std::move(slot.params), item.location().text()};
    const auto same = std::find_if(entries.begin(), entries.end(),
                                   [&](const LossEntry& earlier) { return earlier.type == entry.type; });
    if (same != entries.end()) {
      diagnostics.error("config.loss.twice", entry.where,
                        fmt::format("{}: the term '{}' is already at {}", path, entry.type, same->where),
                        "keep one of them, with the weight that both together should have");
      continue;
    }
    entries.push_back(std::move(entry));
  }
  if (entries.size() > kMostLossTerms) {
    diagnostics.error("config.loss.limit", list->location().text(),
                      fmt::format("losses: {} terms, and a list holds at most {}", entries.size(), kMostLossTerms),
                      "take some out");
    entries.resize(kMostLossTerms);
  }
  return entries;
}

ConfigNode losses_config(const std::vector<LossEntry>& entries) {
  std::vector<ConfigNode> items;
  for (const LossEntry& entry : entries)
    items.push_back(typed_config(entry.type, [&](ParamVisitor& visit) { entry.params->describe(visit); }));
  return ConfigNode::make_list(std::move(items), {});
}

std::vector<std::string> targets_of(const std::vector<LossEntry>& entries) {
  std::vector<std::string> names;
  for (const LossEntry& entry : entries) {
    for (const std::string_view name : entry.loss->traits().targets)
      if (std::find(names.begin(), names.end(), name) == names.end()) names.emplace_back(name);
  }
  return names;
}

bool losses_read(const std::vector<LossEntry>& entries, std::string_view target) {
  return std::any_of(entries.begin(), entries.end(),
                     [&](const LossEntry& entry) { return entry.loss->traits().reads_target(target); });
}

TrainingDepth training_depth(const LoadedScene& scene) {
  TrainingDepth depth;
  for (const int f : scene.frames_of(Split::train)) {
    depth.frames += scene.info.frames[static_cast<std::size_t>(f)].has_depth ? 1 : 0;
    depth.pixels += scene.depth_pixels[static_cast<std::size_t>(f)];
  }
  return depth;
}

std::string depth_use(const std::vector<LossEntry>& entries, const TrainingDepth& depth, Diagnostics& diagnostics) {
  const bool read = losses_read(entries, channel::depth);
  if (depth.frames == 0) return read ? "no training frame has a depth image; colour alone teaches geometry" : "";
  if (!read)
    return fmt::format("depth images of {} training frames give bounds and distances; no loss reads them",
                       depth.frames);
  if (depth.pixels > 0) return fmt::format("depth images of {} training frames will be used", depth.frames);
  diagnostics.warning(
      "scene.depth.empty", "losses",
      fmt::format("the depth images of all {} training frames have no valid pixel, so no term can read them",
                  depth.frames),
      "export z-depth that is finite and above 0, or set losses: []");
  return fmt::format("depth images of {} training frames have no valid pixel", depth.frames);
}

}  // namespace semfield
