#include "settings/loss_config.h"

#include <fmt/format.h>

#include <algorithm>

namespace semfield {

std::vector<LossEntry> read_losses(const ConfigNode& tree, Diagnostics& diagnostics) {
  std::vector<LossEntry> entries;
  const ConfigNode* list = tree.find("losses");
  if (list == nullptr || list->is_null()) return entries;
  if (!list->is_list()) {
    diagnostics.error(list->location().text(), "losses: expected a list of terms {type, ...}",
                      "write losses: [{type: distortion, weight: 0.002}]");
    return entries;
  }
  for (std::size_t i = 0; i < list->items().size(); ++i) {
    const ConfigNode& item = list->items()[i];
    const std::string path = "losses." + std::to_string(i);
    LossEntry entry;
    entry.term = read_typed<LossTerm>(item, path, loss_kinds(), entry.type, diagnostics);
    entry.where = item.location().text();
    if (!entry.term) continue;
    const auto same = std::find_if(entries.begin(), entries.end(),
                                   [&](const LossEntry& earlier) { return earlier.type == entry.type; });
    if (same != entries.end()) {
      diagnostics.error(entry.where,
                        fmt::format("{}: the term '{}' stands at {} already", path, entry.type, same->where),
                        "keep one of them, with the weight that both together should have");
      continue;
    }
    entries.push_back(std::move(entry));
  }
  return entries;
}

ConfigNode losses_config(const std::vector<LossEntry>& entries) {
  std::vector<ConfigNode> items;
  for (const LossEntry& entry : entries)
    items.push_back(typed_config(entry.type, [&](ParamVisitor& visit) { entry.term->describe(visit); }));
  return ConfigNode::make_list(std::move(items), {});
}

bool losses_read_depth(const std::vector<LossEntry>& entries) {
  return std::any_of(entries.begin(), entries.end(),
                     [](const LossEntry& entry) { return entry.term->traits().reads_depth; });
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
  const bool read = losses_read_depth(entries);
  if (depth.frames == 0) return read ? "no training frame has a depth image; colour alone teaches geometry" : "";
  if (!read)
    return fmt::format("depth images of {} training frames give bounds and distances; no loss reads them",
                       depth.frames);
  if (depth.pixels > 0) return fmt::format("depth images of {} training frames will be used", depth.frames);
  diagnostics.warning(
      "losses",
      fmt::format("the depth images of all {} training frames have no valid pixel, so no term can read them",
                  depth.frames),
      "export z-depth that is finite and above 0, or set losses: []");
  return fmt::format("depth images of {} training frames have no valid pixel", depth.frames);
}

std::vector<LossDoc> describe_losses() {
  std::vector<LossDoc> docs;
  for (const LossKind& kind : loss_kinds()) {
    const std::unique_ptr<LossTerm> term = kind.make();
    docs.push_back({std::string(kind.type), std::string(kind.sentence),
                    describe_params([&](ParamVisitor& visit) { term->describe(visit); })});
  }
  return docs;
}

}  // namespace semfield
