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

void require_loss_data(const std::vector<LossEntry>& entries, const SceneInfo& scene, Diagnostics& diagnostics) {
  int frames = 0;
  for (const FrameInfo& frame : scene.frames) {
    if (frame.split != Split::train) continue;
    if (frame.has_depth) return;
    ++frames;
  }
  for (const LossEntry& entry : entries) {
    if (!entry.term->traits().reads_depth) continue;
    diagnostics.error(
        entry.where,
        fmt::format("losses: the term '{}' needs depth images of training frames, and none of the {} "
                    "training frames has one",
                    entry.type, frames),
        fmt::format("take {{type: {}}} out of the list `losses`, or give the scene depth images", entry.type));
  }
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
