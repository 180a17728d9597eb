// The way of a key: config/compose.cpp makes one tree of files and --set; each_section() below names every section
// once, and by that list sections are read, validated, written to run.yaml and documented; config/params.cpp reads
// the keys of one by its describe(), which stands with its struct, as in train_settings.h, and explain.cpp writes
// and documents them.
#include "config/settings/run_config.h"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <string_view>

#include "config/config_words.h"
#include "core/text.h"

namespace semfield {

namespace {

// Every fixed section of `config`, as `section(key path, sentence, params)`: the one list by which sections are read,
// validated, written and documented.
template <class Config, class Fn>
void each_section(Config& config, Fn&& section) {
  section("scene.labels", "which training frames keep their labels", config.labels.selection);
  section("scene.load", "size, bounds and distances of the loaded scene", config.load);
  section("semantics", "the semantic head and its loss", config.semantics);
  section("rendering", "fixed rules of volume rendering", config.rendering);
  section("train", "length and batches of the run", config.train);
  section("train.cameras", "corrections of training cameras", config.cameras);
  section("train.adam", "optimiser [Kingma15]", config.adam);
  section("train.schedule", "learning rate over the steps", config.schedule);
  section("train.self_training", "labels that the field gives to unlabelled training pixels", config.self_training);
  section("runtime", "device, threads, seed and exact savings", config.runtime);
  section("report", "what a run measures and stores", config.report);
  section("fuse", "labels of several views combined by `semfield labels fuse`", config.fuse);
  section("propagate", "labels spread over a run's surface by `semfield labels propagate`", config.propagate);
  section("objects", "objects that `semfield objects` finds from segments of images", config.objects);
  section("objects.damage", "damage to the segments, for experiments", config.segment_damage);
  section("limits", "largest inputs; larger ones are refused", config.limits);
}

// Keys that are no parameters of a section, besides the sections themselves.
constexpr std::string_view kOtherKeys =
    "heads losses passes plugins name base_dir scene.labels.from scene.labels.degrade train.schedule.legs "
    "objects.method";

// Keys of older versions, and what to do instead.
struct GoneKey {
  const char *section, *key, *remedy;
};
constexpr GoneKey kGoneKeys[] = {
    {"train", "time_limit_s", "write train: {steps: 0, time_s: SECONDS} to have steps and schedule settled for a time"},
    {"runtime", "gemm", "remove the key; runtime.precision: bf16 is the faster arithmetic"},
};

// Keys that the map at `path` may have and that are no parameters of it; "": the top.
std::vector<std::string> other_keys(std::string_view path) {
  std::vector<std::string> keys;
  const auto add = [&](std::string_view known) {
    if (!path.empty() && !(known.starts_with(path) && known.substr(path.size()).starts_with('.'))) return;
    const std::string_view below = path.empty() ? known : known.substr(path.size() + 1);
    std::string key(below.substr(0, below.find('.')));
    if (std::find(keys.begin(), keys.end(), key) == keys.end()) keys.push_back(std::move(key));
  };
  const RunConfig defaults;
  each_section(defaults, [&](std::string_view known, const char*, const auto&) { add(known); });
  for (const std::string_view known : words_of(kOtherKeys)) add(known);
  return keys;
}

void refuse_gone_keys(ConfigNode& tree, Diagnostics& diagnostics) {
  for (const GoneKey& gone : kGoneKeys) {
    ConfigNode* section = tree.find(gone.section);
    const ConfigNode* value = section != nullptr ? section->find(gone.key) : nullptr;
    if (value == nullptr) continue;
    diagnostics.error("config.key.gone", value->key_location().text(),
                      fmt::format("{}: {} is gone", gone.section, gone.key), gone.remedy);
    *section = section->without(gone.key);
  }
}

// Relations between the values of a section; a finding's place is that of its key where the section's map has it.
template <class Params>
void validate_section(const ConfigNode& tree, const std::string& path, const Params& params, Diagnostics& diagnostics) {
  Diagnostics relations;
  if constexpr (requires { validate(params, relations); }) validate(params, relations);
  for (const Diagnostic& finding : relations.all()) {
    const ConfigNode* section = tree.find_path(path);
    const std::string key = finding.where.substr(std::min(finding.where.rfind('.') + 1, finding.where.size()));
    const ConfigNode* value = section != nullptr && section->is_map() ? section->find(key) : nullptr;
    const ConfigNode& place = value != nullptr ? *value : section != nullptr ? *section : tree;
    diagnostics.error(finding.code, place.location().text(),
                      finding.where.empty() ? finding.message : finding.where + ": " + finding.message, finding.remedy);
  }
}

bool is_of_the_written(Code code) {
  return code == "config.key.unknown" || code == "config.value.type" || code == "config.value.range" ||
         code == "config.value.choice" || code == "plugin.name.unknown";
}

ConfigNode text_node(const std::string& text) { return ConfigNode::make_scalar(text, true, {}); }

}  // namespace

RunConfig read_run_config(const ConfigNode& written, Registry& registry, Diagnostics& diagnostics) {
  RunConfig config;
  if (!written.is_map()) {
    diagnostics.error("config.value.type", written.location().text(),
                      "expected a map of sections at the top of the config", {});
    return config;
  }
  ConfigNode tree = written;
  const ConfigNode* rendering = tree.find("rendering");
  if (tree.find("base_dir") != nullptr && rendering != nullptr && rendering->is_map() &&
      rendering->find("unit_m") == nullptr)
    // Runs of 1.0 say no unit: their density is per metre.
    tree.set_path("rendering.unit_m", ConfigNode::make_scalar("1", false, tree.location()));
  refuse_unknown_keys(tree, "unknown section", other_keys(""), diagnostics);
  refuse_gone_keys(tree, diagnostics);
  config.name = read_text(tree, "", "name", "run", diagnostics);
  config.base_dir = read_text(tree, "", "base_dir", "", diagnostics);
  const bool loaded = load_modules(tree, registry, diagnostics);
  config.plugins = registry.module_files();
  if (!loaded) return config;  // every name of theirs would be an error
  read_scene(tree, registry, config, diagnostics);
  each_section(config, [&](const char* path, const char*, auto& params) {
    if (const ConfigNode* node = tree.given(path))
      read_params(*node, path, described(params), diagnostics, other_keys(path));
  });
  each_section(config, [&](const char* path, const char*, const auto& params) {
    validate_section(tree, path, params, diagnostics);
  });
  read_parts(tree, registry, config, diagnostics);
  if (config.base_dir.empty()) config.base_dir = std::filesystem::current_path().string();
  config.load.contracted = config.rendering.outside == Outside::contracted;
  return config;
}

RunConfig run_config_of(const ConfigNode& tree, Registry& registry) {
  Diagnostics diagnostics;
  RunConfig config = read_run_config(tree, registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  return config;
}

RunConfig load_run_config(const std::string& path, const std::vector<std::string>& overrides, Registry& registry) {
  const std::string file = find_config(path);
  Diagnostics problems, found;
  const ConfigNode tree = compose_config(file, overrides, &problems);
  RunConfig config = read_run_config(tree, registry, found);
  // Without what could not be included or set, only what is written can be wrong, and not what is missing.
  for (const Diagnostic& finding : found.all())
    if (finding.severity == Severity::error && (!problems.has_errors() || is_of_the_written(finding.code)))
      problems.add(finding);
  problems.throw_if_errors(ErrorKind::config, "");
  if (tree.find("name") == nullptr) config.name = std::filesystem::path(file).stem().string();
  return config;
}

ConfigNode resolved_config(const RunConfig& config) {
  ConfigNode tree;
  tree.set("name", text_node(config.name));
  tree.set("base_dir", text_node(config.base_dir));
  if (config.dataset.entry != nullptr) tree.set("scene", slot_config(config.dataset));
  each_section(config, [&](std::string_view path, const char*, auto params) {
    tree.set_path(path, params_to_config(described(params)));
  });
  // Only `tune` sets these: records of all other runs do without.
  if (config.load.hold_out == 0) tree.set_path("scene.load", tree.find_path("scene.load")->without("hold_out"));
  if (config.report.eval_stride == 1) tree.set("report", tree.find("report")->without("eval_stride"));
  write_parts(config, tree);
  if (!config.plugins.empty()) tree.set("plugins", ConfigNode::list_of(config.plugins, text_node));
  return tree;
}

std::vector<SectionDoc> describe_sections() {
  std::vector<SectionDoc> docs;
  RunConfig defaults;
  each_section(defaults, [&](const char* path, const char* sentence, auto& params) {
    docs.push_back({path, sentence, describe_params(described(params))});
  });
  document_parts(docs);
  return docs;
}

}  // namespace semfield
