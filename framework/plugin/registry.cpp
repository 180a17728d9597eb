// The registry: entries by kind and name.
#include "plugin/registry.h"

#include "plugin/mlp/mlp.h"

namespace semfield {

namespace {
// By PluginKind: in sentences, and the folder of its plugins.
constexpr std::pair<std::string_view, std::string_view> kKindNames[] = {
    {"encoder", "encoders"},  {"field", "fields"}, {"sampler", "samplers"},           {"dataset", "datasets"},
    {"head", "heads"},        {"loss", "losses"},  {"label reader", "label_readers"}, {"degradation", "degradations"},
    {"grouping", "groupings"}};
static_assert(std::size(kKindNames) == kPluginKinds.size());
}  // namespace

std::string_view kind_name(PluginKind kind) { return kKindNames[static_cast<std::size_t>(kind)].first; }
std::string_view kind_folder(PluginKind kind) { return kKindNames[static_cast<std::size_t>(kind)].second; }

Registry::Registry() {
  mlp_kernels(kernels_);
  kernels_.add(Device::cpu, kHeadOwner, &cpu_head_kernels<float>());
  kernels_.add(Device::cpu, kHeadOwner, &cpu_head_kernels<double>());
}

void Registry::add(PluginEntry entry) {
  entry.module = current_module_;
  if (const PluginEntry* taken = find(entry.kind, entry.name)) {
    throw Error(ErrorKind::unavailable, "plugin.name.taken",
                "the " + std::string(kind_name(entry.kind)) + " name '" + entry.name + "' of module '" + entry.module +
                    "' is taken by module '" + taken->module + "'",
                "give one of them another name or load only one");
  }
  auto key = std::pair(entry.kind, entry.name);
  entries_.emplace(std::move(key), std::move(entry));
}

const PluginEntry& Registry::usual_grouping() const {
  for (const auto& [key, entry] : entries_) {
    if (entry.usual) return entry;
  }
  throw Error(ErrorKind::unavailable, "plugin.grouping.usual", "this build lacks the default grouping",
              "name one: --set objects.method.type=NAME");
}

const PluginEntry* Registry::find(PluginKind kind, std::string_view name) const {
  const auto found = entries_.find({kind, std::string(name)});
  return found == entries_.end() ? nullptr : &found->second;
}

const PluginEntry& Registry::get(PluginKind kind, std::string_view name) const {
  if (const PluginEntry* found = find(kind, name)) return *found;
  const std::vector<std::string> known = names(kind);
  std::string text = "no " + std::string(kind_name(kind)) + " named '" + std::string(name) +
                     "'; known: " + (known.empty() ? "none" : join(known));
  throw Error(ErrorKind::config, "plugin.name.unknown", text, near_name_remedy(name, known));
}

std::vector<const PluginEntry*> Registry::entries() const {
  std::vector<const PluginEntry*> all;
  all.reserve(entries_.size());
  for (const auto& [key, entry] : entries_) all.push_back(&entry);
  return all;
}

std::vector<std::string> Registry::names(PluginKind kind) const {
  std::vector<std::string> all;
  for (const auto& [key, entry] : entries_) {
    if (key.first == kind) all.push_back(key.second);
  }
  return all;
}

}  // namespace semfield
