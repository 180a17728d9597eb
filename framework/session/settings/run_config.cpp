#include "session/settings/run_config.h"

#include <algorithm>
#include <filesystem>
#include <functional>

#include "config/compose.h"
#include "config/shipped_config.h"
#include "core/device_id.h"
#include "core/spelling.h"
#include "plugin/loader.h"
#include "session/settings/head_config.h"
#include "session/settings/label_config.h"
#include "session/settings/loss_config.h"
#include "session/settings/pass_config.h"
#include "session/settings/run_length.h"

namespace semfield {

void describe(ParamVisitor& visit, TrainParams& p) {
  SEMFIELD_PARAM(
      visit, p, steps,
      "optimiser steps of the run; 0: as many as fit into time_s, or without it 3000 on a CPU and 20000 on a "
      "GPU, and run.yaml has the number",
      {0, 1e9});
  SEMFIELD_PARAM(visit, p, time_s,
                 "seconds of training that steps and schedule are settled for where steps is 0; 0: none", {0, 1e8});
  SEMFIELD_PARAM(visit, p, rays, "rays per step; 0: 1024 on a CPU and 8192 on a GPU, and run.yaml has the number",
                 {0, 1 << 20});
  SEMFIELD_PARAM(
      visit, p, ray_source,
      "where a step's rays come from: pixels of all images or of one, drawn evenly; label_balanced draws "
      "labelled_share of them from labelled pixels; auto is label_balanced where training pixels have labels or "
      "may get them, else all_images, and run.yaml has the choice");
  SEMFIELD_PARAM(visit, p, labelled_share, "share of rays from labelled pixels, for label_balanced", {0, 1});
  SEMFIELD_PARAM(
      visit, p, label_rays_teach_color,
      "false: rays that label_balanced draws for their labels do not enter the colour loss, which then "
      "comes from evenly drawn rays alone. A few labelled pixels that are drawn again and again spoil geometry");
}

void validate(const TrainParams& p, Diagnostics& diagnostics) {
  const bool balanced = p.ray_source == RaySourceKind::label_balanced || p.ray_source == RaySourceKind::automatic;
  if (!balanced || p.label_rays_teach_color || p.labelled_share < 1) return;
  diagnostics.error("config.value.conflict", "train.labelled_share",
                    "1 draws every ray for its label, and label_rays_teach_color is false: nothing would teach colour",
                    "lower labelled_share, or set train.label_rays_teach_color: true");
}

void describe(ParamVisitor& visit, CameraParams& p) {
  SEMFIELD_PARAM(
      visit, p, poses,
      "poses of training cameras: as given, or learned with the field where they are off by more than a pixel; "
      "right ones suffer from it. auto is learned where a phone's tracker gave them, and run.yaml has the choice");
  SEMFIELD_PARAM(visit, p, colors,
                 "colours of training cameras: as given, or learned, an affine map per camera, where exposure or white "
                 "balance changes between photographs; auto looks whether brightness of overlapping frames does");
  SEMFIELD_PARAM(
      visit, p, pose_rate,
      "factor to the learning rate of poses, in radians and shifts in halves of the scene's longest side; it "
      "falls with the third power of the schedule",
      {0, 1e6});
  SEMFIELD_PARAM(
      visit, p, from_step,
      "share of the run after which poses and colours move: before it the field is fog, which moves right ones",
      {0, 1});
  SEMFIELD_PARAM(visit, p, color_rate, "factor to the learning rate of colours; it falls with the third power too",
                 {0, 1e6});
}

void describe(ParamVisitor& visit, SelfTrainingParams& p) {
  SEMFIELD_PARAM(visit, p, at,
                 "shares of train.steps, ascending, at which the field labels the training pixels that it is sure of; "
                 "empty: never",
                 {1e-6, 0.999999});
  SEMFIELD_PARAM(visit, p, confidence, "least probability of a pixel's most probable class that becomes its label",
                 {0, 1});
  SEMFIELD_PARAM(visit, p, min_opacity, "opacity of a rendered pixel below which it gets no label", {0, 1});
}

void validate(const SelfTrainingParams& p, Diagnostics& diagnostics) {
  if (std::is_sorted(p.at.begin(), p.at.end(), std::less_equal<>())) return;
  diagnostics.error("config.value.order", "train.self_training.at", "the shares do not ascend",
                    "write the smallest first, each once");
}

void describe(ParamVisitor& visit, RuntimeParams& p) {
  SEMFIELD_PARAM(visit, p, device,
                 "where kernels run: auto, cpu, cuda, or cuda:N for GPU N, counted from 0; auto takes the fastest that "
                 "this build and machine have");
  SEMFIELD_PARAM(
      visit, p, precision,
      "precision of the networks' matrix products: fp32; bf16 operands with fp32 sums, weights and gradients; or auto, "
      "which is bf16 where the machine computes it faster and all fields have it, and run.yaml has the choice");
  SEMFIELD_PARAM(
      visit, p, deterministic,
      "GPUs sum in a fixed order, so that every run gives the same bits on any number of equal GPUs; the CPU "
      "always does");
  SEMFIELD_PARAM(visit, p, threads, "CPU threads, 0: every core; results do not depend on it", {0, 4096});
  SEMFIELD_PARAM(visit, p, seed, "seed of every random value");
  SEMFIELD_PARAM(visit, p, lanes,
                 "gradient slots, which also limit the threads of a step; 0: from the work of a step, up to 48, and "
                 "run.yaml has the number; changes the order of sums",
                 {0, 256});
  SEMFIELD_PARAM(visit, p, tile_rays, "rays per tile; 0: from the samplers; changes the order of sums", {0, 1 << 16});
  SEMFIELD_PARAM(
      visit, p, keep,
      "components to build although the scene does not need them, like --keep; `train --dry-run` names them");
  SEMFIELD_PARAM(
      visit, p, memory_gb,
      "most memory that training may take, GB; 0: what is free; a run that needs more is refused at the start",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, fold_feature_layer, "multiply a field's feature and view layer once per step (exact)");
  SEMFIELD_PARAM(visit, p, direction_once_per_ray, "compute the view layer's direction term once per ray (exact)");
  SEMFIELD_PARAM(visit, p, deferred_class_layer, "apply the class layer once per ray, after compositing (exact)");
}

void validate(const RuntimeParams& p, Diagnostics& diagnostics) {
  if (p.device == "auto" || device_of(p.device)) return;
  const std::string near = did_you_mean(p.device, {"auto", "cpu", "cuda"});
  diagnostics.error("config.value.choice", "runtime.device",
                    "expected one of auto, cpu, cuda, or cuda:N for GPU N counted from 0, got '" + p.device + "'",
                    near.empty() ? "write one of them" : "did you mean '" + near + "'?");
}

void describe(ParamVisitor& visit, ReportParams& p) {
  SEMFIELD_PARAM(visit, p, log_every_steps, "steps between rows of metrics.jsonl", {1, 1e9});
  SEMFIELD_PARAM(visit, p, eval_every_s, "seconds of training between evaluations on test frames; 0: only at the end",
                 {0, 1e8});
  SEMFIELD_PARAM(visit, p, eval_frames,
                 "test frames of an evaluation while training, evenly spaced; the last one takes all", {1, 1e6});
  SEMFIELD_PARAM(
      visit, p, eval_share,
      "share of the training time that evaluation may take; to stay within it, evaluations become rarer and read "
      "fewer pixels; so does the last one of a run with train.time_s, of every test frame, and says so; 0: no bound",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, checkpoint_every_s, "seconds between checkpoints; 0: only at the end", {0, 1e8});
  SEMFIELD_PARAM(visit, p, keep_checkpoints, "checkpoints that stay on disk", {2, 1e6});
  SEMFIELD_PARAM(visit, p, strips, "test frames shown in the report", {0, 64});
  SEMFIELD_PARAM(
      visit, p, training_frames,
      "training frames, evenly spaced, on which the field and the training labels are scored at the end against "
      "the scene's own labels; 0: none",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, worst_frames, "test frames with the lowest scores shown in the report", {0, 64});
}

namespace {

// Calls `section(key path, params)` for every fixed section of `config`: the one list that reading, writing and
// documenting share.
template <class Config, class Fn>
void each_section(Config& config, Fn&& section) {
  section("scene.labels", "which training frames keep their labels", config.labels.selection);
  section("scene.load", "size, bounds and distances of the loaded scene", config.load);
  section("semantics", "the semantic head and its loss", config.semantics);
  section("rendering", "fixed rules of volume rendering", config.rendering);
  section("train", "length and batches of the run", config.train);
  section("train.cameras", "what is believed of training cameras", config.cameras);
  section("train.adam", "optimiser [Kingma15]", config.adam);
  section("train.schedule", "learning rate over the steps", config.schedule);
  section("train.self_training", "labels that the field gives to unlabelled training pixels", config.self_training);
  section("runtime", "device, threads, seed and exact savings", config.runtime);
  section("report", "what is measured and kept while training", config.report);
  section("fuse", "labels of several views combined by `semfield fuse`", config.fuse);
  section("propagate", "labels spread over a run's surface by `semfield propagate`", config.propagate);
  section("objects", "objects of segments of images, found by `semfield objects`", config.objects);
  section("objects.damage", "what is done to segments before, for evaluations", config.segment_damage);
  section("limits", "how large inputs may be; what is larger is refused", config.limits);
}

// The keys at the top: those of the sections, and of what is no section of parameters.
std::vector<std::string> top_keys() {
  std::vector<std::string> keys;
  RunConfig defaults;
  each_section(defaults, [&](std::string_view path, const char*, auto&) {
    std::string key(path.substr(0, path.find('.')));
    if (std::find(keys.begin(), keys.end(), key) == keys.end()) keys.push_back(std::move(key));
  });
  keys.insert(keys.end(), {"heads", "losses", "passes", "plugins", "name", "base_dir"});
  return keys;
}

// Sub-sections of a section, which are keys of its map but no parameters.
std::vector<std::string> nested_keys(std::string_view path) {
  if (path == "train") return {"adam", "cameras", "schedule", "self_training"};
  if (path == "train.schedule") return {"legs"};
  if (path == "scene.labels") return {"from", "degrade"};
  if (path == "objects") return {"method", "damage"};
  return {};
}

const ConfigNode* find_path(const ConfigNode& tree, std::string_view path) {
  const ConfigNode* node = &tree;
  while (node != nullptr && !path.empty()) {
    const std::size_t dot = path.find('.');
    node = node->find(path.substr(0, dot));
    path = dot == std::string_view::npos ? std::string_view() : path.substr(dot + 1);
  }
  return node;
}

// Relations between the values of a section; a finding's place is that of its key where the section's map has it.
template <class Params>
void validate_section(const ConfigNode& tree, const std::string& path, const Params& params, Diagnostics& diagnostics) {
  Diagnostics relations;
  validate(params, relations);
  for (const Diagnostic& finding : relations.all()) {
    const ConfigNode* section = find_path(tree, path);
    const std::string key = finding.where.substr(std::min(finding.where.rfind('.') + 1, finding.where.size()));
    const ConfigNode* value = section != nullptr && section->is_map() ? section->find(key) : nullptr;
    const ConfigNode& nearest = value != nullptr ? *value : section != nullptr ? *section : tree;
    diagnostics.error(finding.code, nearest.location().text(),
                      finding.where.empty() ? finding.message : finding.where + ": " + finding.message, finding.remedy);
  }
}

void read_scene(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics) {
  const ConfigNode* scene = tree.find("scene");
  if (scene == nullptr) {
    diagnostics.error(
        "config.key.missing", tree.location().text(), "scene: section is missing",
        "name a dataset: scene: {type: TYPE, ...}, TYPE one of " + join(registry.names(PluginKind::dataset)));
    return;
  }
  // By convention these keys of a scene are paths: relative to the file that wrote them, or to the working folder for
  // --set.
  ConfigNode anchored = *scene;
  for (const char* key : {"root", "file", "classes"}) {
    const ConfigNode* value = scene->is_map() ? scene->find(key) : nullptr;
    if (value == nullptr || !value->is_scalar() || value->text().empty()) continue;
    if (!config.base_dir.empty() && value->location().line > 0) continue;  // of a run.yaml: absolute, or from base_dir
    anchored = anchored.with(key, ConfigNode::make_scalar(resolve_path(*value), true, value->location()));
  }
  config.dataset = read_slot(PluginKind::dataset, anchored, "scene", registry, diagnostics, {"labels", "load"});
  if (const ConfigNode* labels = scene->is_map() ? scene->find("labels") : nullptr;
      labels != nullptr && labels->is_map()) {
    read_label_steps(*labels, !config.base_dir.empty(), registry, config.labels, diagnostics);
  }
  if (config.base_dir.empty()) config.base_dir = std::filesystem::current_path().string();
}

ConfigNode with_path(const ConfigNode& tree, const std::string& path, const ConfigNode& value) {
  const std::size_t dot = path.find('.');
  if (dot == std::string::npos) return tree.with(path, value);
  const std::string key = path.substr(0, dot);
  const ConfigNode* child = tree.find(key);
  return tree.with(key, with_path(child == nullptr ? ConfigNode() : *child, path.substr(dot + 1), value));
}

// Runs of earlier versions have a limit beside a number of steps: what it says of their last evaluation still holds.
ConfigNode with_former_limit(const ConfigNode& tree, Diagnostics& diagnostics) {
  const ConfigNode* train = tree.find("train");
  const ConfigNode* limit = train != nullptr && train->is_map() ? train->find("time_limit_s") : nullptr;
  if (limit == nullptr) return tree;
  if (tree.find("base_dir") == nullptr || train->find("time_s") != nullptr) {
    diagnostics.error("config.key.gone", limit->key_location().text(),
                      "train: time_limit_s is gone: a run ends at its steps",
                      "write train: {steps: 0, time_s: SECONDS} to have steps and schedule settled for a time");
  }
  ConfigNode now = train->without("time_limit_s");
  if (now.find("time_s") == nullptr) now = now.with("time_s", *limit);
  return tree.with("train", now);
}

// Runs of 1.0 say no unit: their density is per metre.
ConfigNode with_former_unit(const ConfigNode& tree) {
  const ConfigNode* rendering = tree.find("rendering");
  if (tree.find("base_dir") == nullptr || rendering == nullptr || !rendering->is_map()) return tree;
  if (rendering->find("unit_m") != nullptr) return tree;
  return with_path(tree, "rendering.unit_m", ConfigNode::make_scalar("1", false, tree.location()));
}

// Runs of earlier versions say who multiplies matrices. What they say of our own kernels still holds.
ConfigNode without_former_keys(const ConfigNode& written, Diagnostics& diagnostics) {
  const ConfigNode tree = with_former_limit(with_former_unit(written), diagnostics);
  const ConfigNode* runtime = tree.find("runtime");
  const ConfigNode* gemm = runtime != nullptr && runtime->is_map() ? runtime->find("gemm") : nullptr;
  if (gemm == nullptr) return tree;
  if (gemm->text() != "auto" && gemm->text() != "builtin") {
    diagnostics.error("config.key.gone", gemm->key_location().text(),
                      "runtime: gemm is gone, Semfield multiplies matrices by its own kernels alone",
                      "remove the key; runtime.precision: bf16 is the faster arithmetic");
  }
  return tree.with("runtime", runtime->without("gemm"));
}

}  // namespace

RunConfig read_run_config(const ConfigNode& written, Registry& registry, Diagnostics& diagnostics) {
  RunConfig config;
  if (!written.is_map()) {
    diagnostics.error("config.value.type", written.location().text(),
                      "expected a map of sections at the top of the config", {});
    return config;
  }
  const ConfigNode tree = without_former_keys(written, diagnostics);
  const std::vector<std::string> known = top_keys();
  for (const auto& [key, value] : tree.entries()) {
    if (std::find(known.begin(), known.end(), key) != known.end()) continue;
    const std::string near = did_you_mean(key, known);
    diagnostics.error("config.key.unknown", value.key_location().text(), "unknown section '" + key + "'",
                      near.empty() ? "known: " + join(known) : "did you mean '" + near + "'?");
  }
  config.name = read_text(tree, "", "name", "run", diagnostics);
  config.base_dir = read_text(tree, "", "base_dir", "", diagnostics);
  if (const ConfigNode* plugins = tree.find("plugins"); plugins != nullptr && !plugins->is_null()) {
    if (!plugins->is_list())
      diagnostics.error("config.value.type", plugins->location().text(), "plugins: expected a list of module files",
                        {});
    bool loaded = true;
    for (const ConfigNode& item : plugins->items()) {
      try {
        load_listed_module(registry, resolve_path(item));
      } catch (const Error& error) {
        diagnostics.error(error.code(), item.location().text(), error.message(), error.remedy());
        loaded = false;
      }
    }
    if (!loaded) return config;  // every name of theirs would be an error
  }
  config.plugins = registry.module_files();
  const bool of_a_run = !config.base_dir.empty();
  read_scene(tree, registry, config, diagnostics);
  each_section(config, [&](const char* path, const char*, auto& params) {
    const ConfigNode* node = find_path(tree, path);
    if (node == nullptr || node->is_null()) return;
    read_params(
        *node, path, [&](ParamVisitor& visit) { describe(visit, params); }, diagnostics, nested_keys(path));
  });
  if (const ConfigNode* legs = find_path(tree, "train.schedule.legs"))
    config.schedule.legs = read_legs(*legs, diagnostics);
  if (const ConfigNode* labels = find_path(tree, "scene.labels"); labels != nullptr && labels->is_map())
    anchor_click_file(*labels, of_a_run, config.labels);
  validate_section(tree, "scene.labels", config.labels.selection, diagnostics);
  validate_section(tree, "scene.load", config.load, diagnostics);
  validate_section(tree, "rendering", config.rendering, diagnostics);
  validate_section(tree, "train", config.train, diagnostics);
  validate_section(tree, "train.self_training", config.self_training, diagnostics);
  validate_section(tree, "runtime", config.runtime, diagnostics);
  validate_section(tree, "fuse", config.fuse, diagnostics);
  validate_section(tree, "propagate", config.propagate, diagnostics);
  if (const ConfigNode* method = find_path(tree, "objects.method"); method != nullptr && !method->is_null())
    config.grouping = read_slot(PluginKind::grouping, *method, "objects.method", registry, diagnostics);
  config.heads = read_heads(tree, registry, diagnostics);
  config.losses = read_losses(tree, registry, diagnostics);
  check_heads_of_losses(config, diagnostics);
  read_passes(tree, registry, config, diagnostics);
  config.load.contracted = config.rendering.outside == Outside::contracted;
  return config;
}

RunConfig run_config_of(const ConfigNode& tree, Registry& registry) {
  Diagnostics diagnostics;
  RunConfig config = read_run_config(tree, registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  return config;
}

namespace {
bool is_of_the_written(Code code) {
  return code == "config.key.unknown" || code == "config.value.type" || code == "config.value.range" ||
         code == "config.value.choice" || code == "plugin.name.unknown";
}
}  // namespace

RunConfig load_run_config(const std::string& path, const std::vector<std::string>& overrides, Registry& registry) {
  const std::string file = find_config(path);
  Diagnostics problems, found;
  const ConfigNode tree = compose_config(file, overrides, problems);
  RunConfig config = read_run_config(tree, registry, found);
  // Without what could not be included or set, only what is written can be wrong, and not what is missing.
  for (const Diagnostic& finding : found.all())
    if (finding.severity == Severity::error && (!problems.has_errors() || is_of_the_written(finding.code)))
      problems.error(finding.code, finding.where, finding.message, finding.remedy);
  problems.throw_if_errors(ErrorKind::config, "");
  if (tree.find("name") == nullptr) config.name = std::filesystem::path(file).stem().string();
  return config;
}

ConfigNode resolved_config(const RunConfig& config) {
  ConfigNode tree = ConfigNode::make_map({}, {});
  tree = tree.with("name", ConfigNode::make_scalar(config.name, true, {}));
  tree = tree.with("base_dir", ConfigNode::make_scalar(config.base_dir, true, {}));
  if (config.dataset.entry != nullptr) tree = tree.with("scene", slot_config(config.dataset));
  RunConfig& editable = const_cast<RunConfig&>(config);  // describe() takes a mutable struct; the writer only looks
  each_section(editable, [&](const char* path, const char*, auto& params) {
    ConfigNode section = params_to_config([&](ParamVisitor& visit) { describe(visit, params); });
    if (std::string_view(path) == "scene.labels") section = with_label_steps(section, config.labels);
    tree = with_path(tree, path, section);
  });
  if (!config.schedule.legs.empty()) tree = with_path(tree, "train.schedule.legs", legs_config(config.schedule.legs));
  if (config.grouping.entry != nullptr) tree = with_path(tree, "objects.method", slot_config(config.grouping));
  if (!config.heads.empty()) tree = tree.with("heads", heads_config(config.heads));
  if (!config.losses.empty()) tree = tree.with("losses", losses_config(config.losses));
  std::vector<ConfigNode> passes;
  for (const PassConfig& pass : config.passes) passes.push_back(pass_config(pass));
  tree = tree.with("passes", ConfigNode::make_list(std::move(passes), {}));
  if (!config.plugins.empty()) {
    std::vector<ConfigNode> modules;
    for (const std::string& module : config.plugins) modules.push_back(ConfigNode::make_scalar(module, true, {}));
    tree = tree.with("plugins", ConfigNode::make_list(std::move(modules), {}));
  }
  return tree;
}

std::vector<SectionDoc> describe_sections() {
  std::vector<SectionDoc> docs;
  RunConfig defaults;
  each_section(defaults, [&](const char* path, const char* sentence, auto& params) {
    docs.push_back({path, sentence, describe_params([&](ParamVisitor& visit) { describe(visit, params); })});
  });
  ScheduleLeg leg;
  docs.push_back({"train.schedule.legs[]",
                  "written by runs that continue beyond their first length: a list of what they train then",
                  describe_params([&](ParamVisitor& visit) { describe(visit, leg); })});
  SemanticBranchConfig branch;
  docs.push_back({"passes[].semantic",
                  "a network of its own for semantics, besides its plugins `position` and `field`, or a list of them "
                  "from which the training labels choose; without this section the head reads the pass's field",
                  describe_params([&](ParamVisitor& visit) { describe(visit, branch); }), true});
  HeadConfig head;
  docs.push_back({"heads[]",
                  "heads in addition to that of class logits: each makes a channel that losses and renderings read",
                  describe_params([&](ParamVisitor& visit) { describe(visit, head); })});
  docs.push_back({"heads[].branch", "the head's own network, besides its plugins `position` and `field`",
                  describe_params([&](ParamVisitor& visit) { describe(visit, head.rules); })});
  return docs;
}

}  // namespace semfield
