#include "session/settings/head_config.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>

#include "session/settings/pass_config.h"

namespace semfield {

void describe(ParamVisitor& visit, HeadConfig& p) {
  SEMFIELD_PARAM(visit, p, channel,
                 "name of the channel that the head makes, and of the dataset's channel that a loss compares with it");
  SEMFIELD_PARAM(visit, p, width,
                 "columns of the channel; fewer than the dataset's has: its principal axes; 0: at most 64 of the "
                 "dataset's",
                 {0, 1024});
  SEMFIELD_PARAM(visit, p, source_width, "columns of the dataset's channel where `width` is smaller; written by a run",
                 {0, 65536});
}

namespace {

const std::vector<std::string> kKeys{"channel", "width", "source_width", "branch"};

// Those that the framework makes or reads itself.
constexpr std::array kTaken{channel::color,   channel::label,  channel::soft_label, channel::depth, channel::alpha,
                            channel::opacity, channel::weight, channel::sigma,      channel::logits};

void check_channel(const HeadConfig& head, const std::vector<HeadConfig>& earlier, const ConfigNode& item,
                   Diagnostics& diagnostics) {
  const auto refuse = [&](const std::string& what, const std::string& remedy) {
    diagnostics.error("config.head.channel", item.location().text(), head.key + ".channel: " + what, remedy);
  };
  const std::string& name = head.channel;
  const auto allowed = [](char c) { return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '_'; };
  if (name.empty()) return refuse("the head names no channel", "name the channel that it is to make, as `clip`");
  if (!std::all_of(name.begin(), name.end(), allowed))
    refuse("'" + name + "' cannot name a channel", "take small letters, digits and underscores");
  if (std::find(kTaken.begin(), kTaken.end(), name) != kTaken.end())
    refuse("'" + name + "' is a channel of the framework", "take another name");
  for (const HeadConfig& other : earlier)
    if (other.channel == name) refuse("'" + name + "' is made by " + other.key + " already", "keep one of them");
}

HeadConfig read_head(const ConfigNode& item, const std::string& path, const Registry& registry,
                     Diagnostics& diagnostics) {
  HeadConfig head;
  head.key = path;
  head.head = read_slot(PluginKind::head, item, path, registry, diagnostics, kKeys);
  if (head.head.entry == nullptr) return head;
  std::vector<std::string> of_plugin{"type", "branch"};
  for (const ParamDoc& doc : describe_params([&](ParamVisitor& visit) { head.head.params->describe(visit); }))
    of_plugin.push_back(doc.name);
  read_params(
      item, path, [&](ParamVisitor& visit) { describe(visit, head); }, diagnostics, of_plugin);
  const ConfigNode* branch = item.find("branch");
  if (branch == nullptr || branch->is_null()) {
    diagnostics.error("config.key.missing", item.location().text(), path + ": key 'branch' is missing",
                      "give the head a network of its own: branch: {position: {type: ...}, field: {type: ...}}");
    return head;
  }
  const std::string below = path + ".branch";
  if (read_branch_slots(*branch, below, registry, head.position, head.field, diagnostics))
    read_params(*branch, below, [&](ParamVisitor& visit) { describe(visit, head.rules); }, diagnostics,
                {"position", "field"});
  return head;
}

}  // namespace

std::vector<HeadConfig> read_heads(const ConfigNode& tree, const Registry& registry, Diagnostics& diagnostics) {
  std::vector<HeadConfig> heads;
  const ConfigNode* list = tree.find("heads");
  if (list == nullptr || list->is_null()) return heads;
  if (!list->is_list()) {
    diagnostics.error("config.value.type", list->location().text(),
                      "heads: expected a list of heads {type, channel, branch, ...}",
                      "write heads: [{type: TYPE, channel: NAME, branch: {...}}]");
    return heads;
  }
  for (std::size_t i = 0; i < list->items().size(); ++i) {
    const ConfigNode& item = list->items()[i];
    HeadConfig head = read_head(item, "heads." + std::to_string(i), registry, diagnostics);
    if (head.head.entry == nullptr) continue;
    check_channel(head, heads, item, diagnostics);
    heads.push_back(std::move(head));
  }
  if (heads.size() > kMostHeads)
    diagnostics.error("config.head.limit", list->location().text(),
                      fmt::format("heads: {} heads, and a pass has at most {}", heads.size(), kMostHeads),
                      "take some out");
  return heads;
}

ConfigNode heads_config(const std::vector<HeadConfig>& heads) {
  std::vector<ConfigNode> items;
  for (const HeadConfig& one : heads) {
    auto& head = const_cast<HeadConfig&>(one);  // describe() takes a mutable struct; the writer only looks
    ConfigNode node = slot_config(head.head);
    const ConfigNode own = params_to_config([&](ParamVisitor& visit) { describe(visit, head); });
    for (const auto& [key, value] : own.entries()) node = node.with(key, value);
    const ConfigNode rules = params_to_config([&](ParamVisitor& visit) { describe(visit, head.rules); });
    items.push_back(
        node.with("branch", rules.with("position", slot_config(head.position)).with("field", slot_config(head.field))));
  }
  return ConfigNode::make_list(std::move(items), {});
}

void check_heads_of_losses(const RunConfig& config, Diagnostics& diagnostics) {
  for (const LossEntry& entry : config.losses) {
    for (const std::string_view name : entry.loss->traits().heads) {
      const auto makes = [&](const HeadConfig& head) { return head.channel == name; };
      if (name == channel::logits || std::any_of(config.heads.begin(), config.heads.end(), makes)) continue;
      diagnostics.error("config.loss.channel", entry.where,
                        fmt::format("losses: '{}' reads the channel '{}', which no head makes", entry.type, name),
                        fmt::format("add a head with channel: {} to the list `heads`", name));
    }
  }
}

void settle_heads(RunConfig& config, const SceneInfo& scene) {
  for (HeadConfig& head : config.heads) {
    int columns = 0;
    for (const FrameInfo& frame : scene.frames) {
      for (const FrameChannelInfo& one : frame.channels) {
        if (frame.split != Split::train || one.name != head.channel) continue;
        if (columns == 0) columns = one.cols;
        if (columns != one.cols)
          throw Error(ErrorKind::data, "scene.channel.columns",
                      fmt::format("frame '{}': its channel '{}' has {} columns, and that of earlier frames {}",
                                  frame.name, head.channel, one.cols, columns),
                      "write the maps of all frames with the same model");
      }
    }
    if (head.source_width > 0 && columns > 0 && columns != head.source_width)
      throw Error(ErrorKind::data, "scene.channel.changed",
                  fmt::format("{}: the dataset's channel '{}' has {} columns, and the run was trained on {}", head.key,
                              head.channel, columns, head.source_width),
                  "give it the maps that it was trained on");
    if (head.width == 0) head.width = std::min(columns, kUsualHeadWidth);
    if (head.width == 0)
      throw Error(ErrorKind::config, "config.head.width",
                  fmt::format("{}.width: no training frame has a channel '{}', so its columns are not known", head.key,
                              head.channel),
                  "set width, or give the dataset the channel");
    if (columns > 0 && head.width > columns)
      throw Error(ErrorKind::config, "config.head.width",
                  fmt::format("{}.width: {} columns are asked for, and the dataset's channel '{}' has {}", head.key,
                              head.width, head.channel, columns),
                  "set it to at most that, or to 0");
    if (columns > head.width) head.source_width = columns;
  }
}

}  // namespace semfield
