#include "session/settings/run_config.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <functional>
#include <initializer_list>

#include "config/compose.h"
#include "core/text.h"
#include "core/view.h"
#include "labels/clicks/click_log.h"
#include "model/pass.h"
#include "plugin/loader.h"
#include "system/files.h"

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
  SEMFIELD_PARAM(visit, p, deterministic,
                 "a GPU sums in a fixed order, so that every run gives the same bits; the CPU always does");
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
      "most memory that training may take, GB; 0: no limit; images larger than this, or than what is free, are refused "
      "before they are read, and a run that takes more ends after its first steps",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, fold_feature_layer, "multiply a field's feature and view layer once per step (exact)");
  SEMFIELD_PARAM(visit, p, direction_once_per_ray, "compute the view layer's direction term once per ray (exact)");
  SEMFIELD_PARAM(visit, p, deferred_class_layer, "apply the class layer once per ray, after compositing (exact)");
}

void validate(const RuntimeParams& p, Diagnostics& diagnostics) {
  if (p.device == "auto" || device_of(p.device)) return;
  diagnostics.error("config.value.choice", "runtime.device",
                    "expected one of auto, cpu, cuda, or cuda:N for GPU N counted from 0, got '" + p.device + "'",
                    near_name_remedy(p.device, {"auto", "cpu", "cuda"}, "write one of them"));
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

// Every fixed section of `config`, as `section(key path, sentence, params)`: the one list by which sections are read,
// validated, written and documented.
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
  section("fuse", "labels of several views combined by `semfield labels fuse`", config.fuse);
  section("propagate", "labels spread over a run's surface by `semfield labels propagate`", config.propagate);
  section("objects", "objects of segments of images, found by `semfield objects`", config.objects);
  section("objects.damage", "what is done to segments before, for evaluations", config.segment_damage);
  section("limits", "how large inputs may be; what is larger is refused", config.limits);
}

// Keys that are no parameters of a section, besides the sections themselves.
constexpr const char* kOtherKeys[] = {"heads",
                                      "losses",
                                      "passes",
                                      "plugins",
                                      "name",
                                      "base_dir",
                                      "scene.labels.from",
                                      "scene.labels.degrade",
                                      "train.schedule.legs",
                                      "objects.method"};

// Keys of versions before 1.0, and what to do instead.
struct GoneKey {
  const char *section, *key, *remedy;
  std::string_view harmless = {};  // values that say what holds anyway, which versions before 2.0 take
};
constexpr GoneKey kGoneKeys[] = {
    {"train", "time_limit_s", "write train: {steps: 0, time_s: SECONDS} to have steps and schedule settled for a time"},
    {"runtime", "gemm", "remove the key; runtime.precision: bf16 is the faster arithmetic", "auto builtin"},
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
  for (const char* known : kOtherKeys) add(known);
  return keys;
}

// Every plugin of a pass or a branch, as see(key, kind, slot, whether it must be there, sentence): the one list by
// which they are read, written and documented.
template <class Pass, class See>
void each_slot_of(Pass& pass, const See& see) {
  if constexpr (requires { pass.sampler; }) {
    see("sampler", PluginKind::sampler, pass.sampler, true, "where along a ray the field is evaluated");
    see("position", PluginKind::encoder, pass.position, true, "position encoder");
    see("direction", PluginKind::encoder, pass.direction, false,
        "direction encoder; leave it out for a view-independent field");
    see("field", PluginKind::field, pass.field, true, "the network");
  } else {
    see("position", PluginKind::encoder, pass.position, true, "position encoder of the branch");
    see("field", PluginKind::field, pass.field, true, "network of the branch");
  }
}

template <class Params>
Describe described(Params& params) {
  return [&params](ParamVisitor& visit) { describe(visit, params); };
}
Describe described(PluginParams& params) {
  return [&params](ParamVisitor& visit) { params.describe(visit); };
}

// The node at `path`; none where nothing is written there.
const ConfigNode* given(const ConfigNode& node, std::string_view path) {
  const ConfigNode* found = node.find_path(path);
  return found != nullptr && !found->is_null() ? found : nullptr;
}

// Channels that the framework makes or reads itself.
constexpr std::array kTaken{channel::color,   channel::label,  channel::soft_label, channel::depth, channel::alpha,
                            channel::opacity, channel::weight, channel::sigma,      channel::logits};

// Reads a tree, a map, into a configuration; every fault becomes a finding.
class Reading {
 public:
  Reading(ConfigNode tree, Registry& registry, RunConfig& config, Diagnostics& diagnostics)
      : tree_(std::move(tree)), registry_(registry), config_(config), diagnostics_(diagnostics) {}

  void all() {
    const ConfigNode* rendering = map_at("rendering");
    if (tree_.find("base_dir") != nullptr && rendering != nullptr && rendering->find("unit_m") == nullptr)
      // Runs of 1.0 say no unit: their density is per metre.
      tree_.set_path("rendering.unit_m", ConfigNode::make_scalar("1", false, tree_.location()));
    refuse_unknown_keys(tree_, "unknown section", other_keys(""), diagnostics_);
    refuse_gone_keys();
    config_.name = read_text(tree_, "", "name", "run", diagnostics_);
    config_.base_dir = read_text(tree_, "", "base_dir", "", diagnostics_);
    of_a_run_ = !config_.base_dir.empty();
    if (!modules()) return;  // every name of theirs would be an error
    scene();
    each_section(config_, [&](const char* path, const char*, auto& params) {
      if (const ConfigNode* node = given(tree_, path))
        read_params(*node, path, described(params), diagnostics_, other_keys(path));
    });
    legs();
    click_file();
    each_section(config_, [&](const char* path, const char*, const auto& params) { validate_section(path, params); });
    if (const ConfigNode* method = given(tree_, "objects.method"))
      config_.grouping = slot(PluginKind::grouping, *method, "objects.method");
    heads();
    losses();
    check_heads_of_losses();
    passes();
    config_.load.contracted = config_.rendering.outside == Outside::contracted;
  }

 private:
  void error(Code code, const ConfigNode& node, std::string message, std::string remedy = {}) {
    diagnostics_.error(code, node.location().text(), std::move(message), std::move(remedy));
  }
  PluginSlot slot(PluginKind kind, const ConfigNode& node, const std::string& path,
                  const std::vector<std::string>& more_keys = {}) {
    return read_slot(kind, node, path, registry_, diagnostics_, more_keys);
  }
  // The same; no entry where anything in it is wrong.
  PluginSlot sound_slot(PluginKind kind, const ConfigNode& node, const std::string& path) {
    const int errors = diagnostics_.error_count();
    PluginSlot read = slot(kind, node, path);
    return diagnostics_.error_count() == errors ? std::move(read) : PluginSlot();
  }
  // The map at `path`; none where nothing is written there, or no map.
  const ConfigNode* map_at(std::string_view path) const {
    const ConfigNode* map = tree_.find_path(path);
    return map != nullptr && map->is_map() ? map : nullptr;
  }
  // read(item, its path) for the items of the list at `path`. Nothing may be written there; else it is a list.
  template <class Read>
  void each_item(const std::string& path, const std::string& of, const std::string& remedy, const Read& read) {
    const ConfigNode* list = given(tree_, path);
    if (list == nullptr) return;
    if (!list->is_list()) return error("config.value.type", *list, path + ": expected a list of " + of, remedy);
    for (std::size_t i = 0; i < list->items().size(); ++i) read(list->items()[i], path + "." + std::to_string(i));
  }

  void refuse_gone_keys() {
    for (const GoneKey& gone : kGoneKeys) {
      const ConfigNode* section = map_at(gone.section);
      const ConfigNode* value = section != nullptr ? section->find(gone.key) : nullptr;
      if (value == nullptr) continue;
      const std::vector<std::string_view> harmless = words_of(gone.harmless);
      if (std::find(harmless.begin(), harmless.end(), value->text()) == harmless.end())
        diagnostics_.error("config.key.gone", value->key_location().text(),
                           fmt::format("{}: {} is gone", gone.section, gone.key), gone.remedy);
      tree_.set(gone.section, section->without(gone.key));
    }
  }

  // False where a module could not be loaded.
  bool modules() {
    bool loaded = true;
    each_item("plugins", "module files", {}, [&](const ConfigNode& item, const std::string&) {
      try {
        load_listed_module(registry_, resolve_path(item));
      } catch (const Error& fault) {
        error(fault.code(), item, fault.message(), fault.remedy());
        loaded = false;
      }
    });
    config_.plugins = registry_.module_files();
    return loaded;
  }

  // Whether a path has to be made absolute: those of a run.yaml are, or start at its base_dir; --set is always written
  // in the working folder.
  bool starts_elsewhere(const ConfigNode* value) const {
    if (value == nullptr || !value->is_scalar() || value->text().empty()) return false;
    return !of_a_run_ || value->location().line <= 0;
  }
  // `map` with its paths relative to the file that wrote them, or to the working folder.
  ConfigNode anchored(ConfigNode map, std::initializer_list<const char*> keys) const {
    for (const char* key : keys) {
      const ConfigNode* value = map.find(key);
      if (starts_elsewhere(value)) map.set(key, ConfigNode::make_scalar(resolve_path(*value), true, value->location()));
    }
    return map;
  }

  void scene() {
    const ConfigNode* written = tree_.find("scene");
    if (written == nullptr)
      return error("config.key.missing", tree_, "scene: section is missing",
                   "name a dataset: scene: {type: TYPE, ...}, TYPE one of " + one_of(PluginKind::dataset));
    // By convention these keys of a scene are paths.
    config_.dataset =
        slot(PluginKind::dataset, anchored(*written, {"root", "file", "classes"}), "scene", {"labels", "load"});
    if (map_at("scene.labels") != nullptr) label_steps();
    if (!of_a_run_) config_.base_dir = std::filesystem::current_path().string();
  }
  std::string one_of(PluginKind kind) const { return join(registry_.names(kind)); }

  void label_steps() {
    LabelConfig& labels = config_.labels;
    if (const ConfigNode* from = given(tree_, "scene.labels.from")) {
      const PluginSlot reader =
          sound_slot(PluginKind::label_reader, anchored(*from, {"folder", "file", "classes"}), "scene.labels.from");
      if (reader.entry != nullptr) labels.from = {reader.entry->name, reader.entry->label_reader(*reader.params)};
    }
    each_item("scene.labels.degrade", "steps {type, ...}",
              "write degrade: [{type: TYPE, ...}], TYPE one of " + one_of(PluginKind::degradation),
              [&](const ConfigNode& item, const std::string& path) {
                const PluginSlot step = sound_slot(PluginKind::degradation, item, path);
                if (step.entry != nullptr)
                  labels.degrade.push_back({step.entry->name, step.entry->degradation(*step.params)});
              });
  }

  // The path of the key `clicks` becomes absolute. In a run.yaml a relative one starts at the run's folder; an absolute
  // one of the run's own file gives way to that file where it lies next to the run.yaml.
  void click_file() {
    namespace fs = std::filesystem;
    const ConfigNode* value = tree_.find_path("scene.labels.clicks");
    if (value == nullptr || !value->is_scalar() || value->text().empty()) return;
    std::string& clicks = config_.labels.selection.clicks;
    if (starts_elsewhere(value)) {
      clicks = resolve_path(*value);
      return;
    }
    const std::string& written_in = value->location().file;
    if (!is_file(written_in)) return;  // a text that is no file of a run yet
    const fs::path folder = fs::absolute(written_in).parent_path().lexically_normal(), file = value->text();
    config_.labels.run_dir = folder.string();
    if (file.is_absolute() && file.filename() == kClickFile && is_there(folder / kClickFile)) clicks = kClickFile;
  }

  void legs() {
    std::vector<ScheduleLeg>& legs = config_.schedule.legs;
    const ConfigNode* list = given(tree_, "train.schedule.legs");
    each_item("train.schedule.legs", "maps {start, rate, hold_until, end}",
              "`semfield train --resume RUN --time T` writes it", [&](const ConfigNode& item, const std::string& path) {
                ScheduleLeg leg;
                const int errors = diagnostics_.error_count();
                read_params(item, path, described(leg), diagnostics_);
                const bool last = &item == &list->items().back();
                if (diagnostics_.error_count() == errors &&
                    ((!legs.empty() && leg.start <= legs.back().start) || (leg.end == 0 ? !last : leg.end < leg.start)))
                  error("config.schedule.legs", item, path + ": the leg does not follow on the one before",
                        "legs start one after the other, and only the last may have no end yet");
                legs.push_back(leg);
              });
  }

  // Relations between the values of a section; a finding's place is that of its key where the section's map has it.
  template <class Params>
  void validate_section(const std::string& path, const Params& params) {
    Diagnostics relations;
    if constexpr (requires { validate(params, relations); }) validate(params, relations);
    for (const Diagnostic& finding : relations.all()) {
      const ConfigNode* section = tree_.find_path(path);
      const std::string key = finding.where.substr(std::min(finding.where.rfind('.') + 1, finding.where.size()));
      const ConfigNode* value = section != nullptr && section->is_map() ? section->find(key) : nullptr;
      error(finding.code,
            value != nullptr     ? *value
            : section != nullptr ? *section
                                 : tree_,
            finding.where.empty() ? finding.message : finding.where + ": " + finding.message, finding.remedy);
    }
  }

  template <class Pass>
  void slots(const ConfigNode& node, const std::string& path, Pass& pass) {
    each_slot_of(pass, [&](const char* key, PluginKind kind, PluginSlot& of_pass, bool required, const char*) {
      if (const ConfigNode* plugin = given(node, key)) {
        of_pass = slot(kind, *plugin, path + "." + key);
      } else if (required) {
        error("config.key.missing", node, path + ": key '" + key + "' is missing");
      }
    });
  }
  // {position, field} and the parameters that `own` describes.
  void branch(const ConfigNode& node, const std::string& path, BranchConfig& read, const Describe& own) {
    if (!node.is_map()) return error("config.value.type", node, path + ": expected a map {position, field, ...}");
    slots(node, path, read);
    read_params(node, path, own, diagnostics_, {"position", "field"});
  }

  // A channel twice is an error, and so is one that the framework makes itself.
  void heads() {
    each_item("heads", "heads {type, channel, branch, ...}",
              "write heads: [{type: TYPE, channel: NAME, branch: {...}}]",
              [&](const ConfigNode& item, const std::string& path) {
                HeadConfig read = head(item, path);
                if (read.head.entry == nullptr) return;
                check_channel(read, item);
                config_.heads.push_back(std::move(read));
              });
    if (config_.heads.size() > kMostHeads)
      error("config.head.limit", *tree_.find("heads"),
            fmt::format("heads: {} heads, and a pass has at most {}", config_.heads.size(), kMostHeads),
            "take some out");
  }
  HeadConfig head(const ConfigNode& item, const std::string& path) {
    HeadConfig read;
    read.key = path;
    read.head = slot(PluginKind::head, item, path, {"channel", "width", "source_width", "branch"});
    if (read.head.entry == nullptr) return read;
    std::vector<std::string> of_plugin{"type", "branch"};
    for (const ParamDoc& doc : describe_params(described(*read.head.params))) of_plugin.push_back(doc.name);
    read_params(item, path, described<HeadChannel>(read), diagnostics_, of_plugin);
    if (const ConfigNode* own = given(item, "branch")) {
      branch(*own, path + ".branch", read, described(read.rules));
    } else {
      error("config.key.missing", item, path + ": key 'branch' is missing",
            "give the head a network of its own: branch: {position: {type: ...}, field: {type: ...}}");
    }
    return read;
  }
  void check_channel(const HeadConfig& head, const ConfigNode& item) {
    const auto refuse = [&](const std::string& what, const std::string& remedy) {
      error("config.head.channel", item, head.key + ".channel: " + what, remedy);
    };
    const std::string& name = head.channel;
    const auto allowed = [](char c) { return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '_'; };
    if (name.empty()) return refuse("the head names no channel", "name the channel that it is to make, as `clip`");
    if (!std::all_of(name.begin(), name.end(), allowed))
      refuse("'" + name + "' cannot name a channel", "take small letters, digits and underscores");
    if (std::find(kTaken.begin(), kTaken.end(), name) != kTaken.end())
      refuse("'" + name + "' is a channel of the framework", "take another name");
    for (const HeadConfig& other : config_.heads)
      if (other.channel == name) refuse("'" + name + "' is made by " + other.key + " already", "keep one of them");
  }

  // A type twice is an error.
  void losses() {
    std::vector<LossEntry>& entries = config_.losses;
    each_item("losses", "terms {type, ...}", "write losses: [{type: distortion, weight: 0.002}]",
              [&](const ConfigNode& item, const std::string& path) {
                PluginSlot term = sound_slot(PluginKind::loss, item, path);
                if (term.entry == nullptr) return;
                const auto same = std::find_if(entries.begin(), entries.end(),
                                               [&](const LossEntry& other) { return other.type == term.entry->name; });
                if (same != entries.end())
                  return error("config.loss.twice", item,
                               fmt::format("{}: the term '{}' is already at {}", path, same->type, same->where),
                               "keep one of them, with the weight that both together should have");
                std::shared_ptr<const Loss> loss = term.entry->loss(*term.params);
                entries.push_back({term.entry->name, loss, std::move(term.params), item.location().text()});
              });
    if (entries.size() <= kMostLossTerms) return;
    error("config.loss.limit", *tree_.find("losses"),
          fmt::format("losses: {} terms, and a list holds at most {}", entries.size(), kMostLossTerms),
          "take some out");
    entries.resize(kMostLossTerms);
  }
  // An error for each loss that reads a channel which no head makes.
  void check_heads_of_losses() {
    for (const LossEntry& entry : config_.losses) {
      for (const std::string_view name : entry.loss->traits().heads) {
        const auto makes = [&](const HeadConfig& head) { return head.channel == name; };
        if (name == channel::logits || std::any_of(config_.heads.begin(), config_.heads.end(), makes)) continue;
        diagnostics_.error("config.loss.channel", entry.where,
                           fmt::format("losses: '{}' reads the channel '{}', which no head makes", entry.type, name),
                           fmt::format("add a head with channel: {} to the list `heads`", name));
      }
    }
  }

  void passes() {
    const ConfigNode* list = tree_.find("passes");
    if (list == nullptr || !list->is_list() || list->items().empty())
      return error("config.value.type", list == nullptr ? tree_ : *list,
                   "passes: expected a list of at least one pass {name, sampler, position, direction, field}");
    static const std::vector<std::string> kKeys{"name",      "like",  "sampler", "position",
                                                "direction", "field", "semantic"};
    for (std::size_t index = 0; index < list->items().size(); ++index) {
      const ConfigNode& item = list->items()[index];
      const std::string path = "passes." + item_key(*list, index);
      PassConfig pass;
      pass.key = path;
      if (!item.is_map()) {
        error("config.value.type", item, path + ": expected a map {name, sampler, position, direction, field}");
        continue;
      }
      refuse_unknown_keys(item, path + ": unknown key", kKeys, diagnostics_);
      pass.name = read_text(item, path, "name", usual_pass_name(index), diagnostics_);
      slots(item, path, pass);
      if (const ConfigNode* own = given(item, "semantic")) pass.semantic = branches(*own, path + ".semantic");
      for (const PassConfig& other : config_.passes)
        if (other.name == pass.name)
          error("config.pass.twice", item, path + ": name '" + pass.name + "' is taken by an earlier pass");
      config_.passes.push_back(std::move(pass));
    }
  }
  // One branch, or several from which the labels choose: one of them must take labels of any kind.
  std::vector<SemanticBranchConfig> branches(const ConfigNode& node, const std::string& path) {
    std::vector<SemanticBranchConfig> read;
    const auto add = [&](const ConfigNode& item, const std::string& place) {
      SemanticBranchConfig& own = read.emplace_back();
      branch(item, place, own, described(own));
    };
    if (!node.is_list()) {
      add(node, path);
      return read;
    }
    std::array<bool, ChoiceNames<LabelKind>::names.size()> served{};
    constexpr auto kMany = static_cast<std::size_t>(LabelKind::many);
    for (const ConfigNode& item : node.items()) {
      const std::string key = item_key(node, read.size());
      add(item, path + "." + key);
      read.back().key = "semantic." + key;
      bool& known = served[static_cast<std::size_t>(read.back().labels)];
      if (known || served[0] || (read.back().labels == LabelKind::dense && served[kMany]))
        error("config.branch.unreached", item, path + ": an earlier branch takes all labels that this one is for");
      known = true;
    }
    for (std::size_t kind = 1; kind < served.size() && !served[0]; ++kind) {
      const bool among_many = kind == static_cast<std::size_t>(LabelKind::dense) && served[kMany];
      if (!served[kind] && !among_many)
        error("config.branch.missing", node,
              path + ": no branch is for labels: " + choice_name(static_cast<LabelKind>(kind)),
              "add one, or let the last one be for labels: any");
    }
    return read;
  }

  ConfigNode tree_;
  Registry& registry_;
  RunConfig& config_;
  Diagnostics& diagnostics_;
  bool of_a_run_ = false;
};

bool is_of_the_written(Code code) {
  return code == "config.key.unknown" || code == "config.value.type" || code == "config.value.range" ||
         code == "config.value.choice" || code == "plugin.name.unknown";
}

ConfigNode text_node(const std::string& text) { return ConfigNode::make_scalar(text, true, {}); }

// What `items` are as nodes, in a list.
template <class Items, class ToNode>
ConfigNode list_of(const Items& items, const ToNode& to_node) {
  std::vector<ConfigNode> nodes;
  for (const auto& item : items) nodes.push_back(to_node(item));
  return ConfigNode::make_list(std::move(nodes), {});
}

// Every parameter, written out.
template <class Params>
ConfigNode written(Params params) {
  return params_to_config(described(params));
}

// {type, every parameter}.
ConfigNode typed_config(const std::string& type, const Describe& describe) {
  const ConfigNode params = params_to_config(describe);
  ConfigNode node = ConfigNode::make_map({{"type", ConfigNode::make_scalar(type, false, {})}}, {});
  node.entries().insert(node.entries().end(), params.entries().begin(), params.entries().end());
  return node;
}

ConfigNode slot_config(const PluginSlot& slot) { return typed_config(slot.entry->name, described(*slot.params)); }

template <class Pass>
void write_slots(ConfigNode& node, const Pass& pass) {
  each_slot_of(pass, [&](const char* key, PluginKind, const PluginSlot& slot, bool, const char*) {
    if (slot.entry != nullptr) node.set(key, slot_config(slot));
  });
}

// The parameters that `own` describes, and {position, field}.
ConfigNode branch_config(const BranchConfig& branch, const Describe& own) {
  ConfigNode node = params_to_config(own);
  write_slots(node, branch);
  return node;
}

ConfigNode step_config(const std::string& type, LabelStep& step) {
  return typed_config(type, [&](ParamVisitor& visit) { step.describe(visit); });
}

ConfigNode head_config(const HeadConfig& head) {
  ConfigNode node = slot_config(head.head);
  const ConfigNode channel = written<HeadChannel>(head);
  for (const auto& [key, value] : channel.entries()) node.set(key, value);
  BranchRules rules = head.rules;
  node.set("branch", branch_config(head, described(rules)));
  return node;
}

ConfigNode pass_config(const PassConfig& pass) {
  ConfigNode node = ConfigNode::make_map({{"name", text_node(pass.name)}}, {});
  write_slots(node, pass);
  ConfigNode branches = list_of(pass.semantic, [](const SemanticBranchConfig& branch) {
    SemanticBranchConfig own;  // without its plugins
    own.labels = branch.labels;
    own.rules = branch.rules;
    return branch_config(branch, described(own));
  });
  if (branches.items().size() == 1) branches = ConfigNode(branches.items().front());
  if (!pass.semantic.empty()) node.set("semantic", branches);
  return node;
}

}  // namespace

RunConfig read_run_config(const ConfigNode& written, Registry& registry, Diagnostics& diagnostics) {
  RunConfig config;
  if (!written.is_map()) {
    diagnostics.error("config.value.type", written.location().text(),
                      "expected a map of sections at the top of the config", {});
    return config;
  }
  Reading(written, registry, config, diagnostics).all();
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
  each_section(config, [&](std::string_view path, const char*, const auto& params) {
    tree.set_path(path, written(params));
    if (path != "scene.labels") return;
    const LabelConfig& labels = config.labels;
    if (labels.from.reader) tree.set_path("scene.labels.from", step_config(labels.from.type, *labels.from.reader));
    if (!labels.degrade.empty())
      tree.set_path("scene.labels.degrade", list_of(labels.degrade, [](const LabelConfig::Step& step) {
                      return step_config(step.type, *step.degradation);
                    }));
  });
  const std::vector<ScheduleLeg>& legs = config.schedule.legs;
  if (!legs.empty()) tree.set_path("train.schedule.legs", list_of(legs, written<ScheduleLeg>));
  if (config.grouping.entry != nullptr) tree.set_path("objects.method", slot_config(config.grouping));
  if (!config.heads.empty()) tree.set("heads", list_of(config.heads, head_config));
  if (!config.losses.empty())
    tree.set("losses", list_of(config.losses, [](const LossEntry& entry) {
               return typed_config(entry.type, described(*entry.params));
             }));
  tree.set("passes", list_of(config.passes, pass_config));
  if (!config.plugins.empty()) tree.set("plugins", list_of(config.plugins, text_node));
  return tree;
}

std::vector<SchemaSection> describe_sections(const Registry* plugins) {
  std::vector<SchemaSection> docs;
  RunConfig defaults;
  each_section(defaults, [&](const char* path, const char* sentence, auto& params) {
    docs.push_back({path, sentence, describe_params(described(params))});
  });
  ScheduleLeg leg;
  docs.push_back({"train.schedule.legs[]",
                  "written by runs that continue beyond their first length: a list of what they train then",
                  describe_params(described(leg))});
  SemanticBranchConfig branch;
  docs.push_back({"passes[].semantic",
                  "a network of its own for semantics, besides its plugins `position` and `field`, or a list of them "
                  "from which the training labels choose; without this section the head reads the pass's field",
                  describe_params(described(branch)), true});
  HeadConfig head;
  docs.push_back({"heads[]",
                  "heads in addition to that of class logits: each makes a channel that losses and renderings read",
                  describe_params(described<HeadChannel>(head))});
  docs.push_back({"heads[].branch", "the head's own network, besides its plugins `position` and `field`",
                  describe_params(described(head.rules))});
  if (plugins == nullptr) return docs;
  const auto text = [](const char* name, const char* usual, const char* sentence) {
    return ParamDoc{name, "text", usual, "", sentence, {}};
  };
  docs.push_back({"",
                  "",
                  {text("name", "", "name of the run and its default folder"),
                   text("base_dir", "",
                        "folder at which relative paths start that come from no file; default: the working folder"),
                   {"plugins",
                    "list of text",
                    "[]",
                    "",
                    "plugin modules that it needs, by path; see docs/reference/configuration.md for which are loaded",
                    {}}}});
  docs.push_back({"passes[]",
                  "one pass over the rays",
                  {text("name", "main", "name of the pass, the prefix of its tensors"),
                   text("like", "", "an earlier pass that this one starts from")}});
  const auto slot = [&](const std::string& path, PluginKind kind, const char* sentence) {
    SchemaSection& doc = docs.emplace_back(SchemaSection{path, sentence});
    for (const PluginEntry* entry : plugins->entries())
      if (entry->kind == kind)
        doc.alternatives.push_back({entry->name, entry->summary, describe_params(described(*entry->new_params()))});
  };
  const auto slots = [&](const std::string& path, const auto& pass) {
    each_slot_of(pass, [&](const char* key, PluginKind kind, const PluginSlot&, bool, const char* sentence) {
      slot(path + "." + key, kind, sentence);
    });
  };
  slot("losses[]", PluginKind::loss, "terms of the loss in addition to colour and semantics; each type once");
  slot("heads[]", PluginKind::head, "heads in addition to that of class logits");
  slots("heads[].branch", head);
  slot("scene.labels.from", PluginKind::label_reader, "label files to train on instead of the dataset's own labels");
  slot("scene.labels.degrade[]", PluginKind::degradation, "changes of the training labels, in order");
  slot("objects.method", PluginKind::grouping, "what `semfield objects` learns from segments");
  slot("scene", PluginKind::dataset, "where frames come from");
  slots("passes[]", PassConfig());
  slots("passes[].semantic", branch);
  return docs;
}

void describe(ParamVisitor& visit, HeadChannel& p) {
  SEMFIELD_PARAM(visit, p, channel,
                 "name of the channel that the head makes, and of the dataset's channel that a loss compares with it");
  SEMFIELD_PARAM(visit, p, width,
                 "columns of the channel; fewer than the dataset's has: its principal axes; 0: at most 64 of the "
                 "dataset's",
                 {0, 1024});
  SEMFIELD_PARAM(visit, p, source_width, "columns of the dataset's channel where `width` is smaller; written by a run",
                 {0, 65536});
}

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
  read_params(node, path, described(*slot.params), diagnostics, allowed);
  if (diagnostics.error_count() == errors) {
    Diagnostics relations;
    slot.params->validate(relations);
    for (const Diagnostic& finding : relations.all()) {
      const std::string message = path + (finding.where.empty() ? "" : "." + finding.where) + ": " + finding.message;
      const Severity severity = finding.severity == Severity::error ? Severity::error : Severity::warning;
      diagnostics.add({severity, finding.code, node.location().text(), message, finding.remedy});
    }
  }
  return slot;
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

void describe(ParamVisitor& visit, FusionParams& p) {
  SEMFIELD_PARAM(visit, p, methods, "what is computed: monocular (a view's own prediction), bayesian, average");
  SEMFIELD_PARAM(visit, p, depth,
                 "depth that locates a point in other views: the scene's own, or that of a run's field");
  SEMFIELD_PARAM(visit, p, min_opacity, "learned depth: opacity of a rendered pixel below which it has no depth",
                 {0.01, 1});
  SEMFIELD_PARAM(visit, p, tolerance,
                 "length by which the depth of a point and of a view may differ; beyond it the point is hidden; 0: "
                 "1 cm, or 1/500 of the longest side of a scene that is no room in metres",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, p, relative_tolerance, "share of the point's depth that is added to tolerance", {0, 1});
  SEMFIELD_PARAM(visit, p, floor, "bayesian: least probability of a class in one view", {1e-12, 0.5});
  SEMFIELD_PARAM(visit, p, views, "other views asked for each frame; 0: all", {0, 1e6});
  SEMFIELD_PARAM(visit, p, choose,
                 "which views are asked when `views` is not 0: those of the nearest cameras, or evenly spaced frames");
  SEMFIELD_PARAM(
      visit, p, neighbourhood,
      "side of the window of pixels whose predictions are averaged in another view; odd; 1: the nearest pixel",
      {1, 15});
  SEMFIELD_PARAM(visit, p, hard_confidence,
                 "probability of the label in a prediction without probabilities; other classes share the rest",
                 {1e-3, 1});
}

void validate(const FusionParams& p, Diagnostics& diagnostics) {
  if (p.neighbourhood % 2 == 0) {
    diagnostics.error("config.value.range", "fuse.neighbourhood",
                      "a window of " + std::to_string(p.neighbourhood) + " pixels has no centre",
                      "write an odd number");
  }
  if (p.methods.empty())
    diagnostics.error("config.value.missing", "fuse.methods", "no method is named", "write for example [bayesian]");
  try {
    (void)fusion_methods(p.methods);
  } catch (const Error& e) {
    diagnostics.error(e.code(), "", e.message(), e.remedy());
  }
}

bool FusionParams::agree(double a, double b) const { return std::abs(a - b) <= tolerance + relative_tolerance * a; }

std::vector<FusionMethod> fusion_methods(const std::vector<std::string>& names) {
  constexpr auto& known = ChoiceNames<FusionMethod>::names;
  std::vector<FusionMethod> out;
  for (const std::string& name : names) {
    const auto found = std::find(known.begin(), known.end(), name);
    if (found == known.end()) {
      const std::vector<std::string> all(known.begin(), known.end());
      throw Error(ErrorKind::config, "config.value.choice", "fuse.methods: there is no method '" + name + "'",
                  near_name_remedy(name, all, "known: " + join(all)));
    }
    const auto method = static_cast<FusionMethod>(found - known.begin());
    if (std::find(out.begin(), out.end(), method) == out.end()) out.push_back(method);
  }
  return out;
}

void describe(ParamVisitor& visit, ObjectsParams& p) {
  SEMFIELD_PARAM(visit, p, steps, "steps of learning on points of the surface", {1, 1e6});
  SEMFIELD_PARAM(visit, p, views, "views of a step", {1, 256});
  SEMFIELD_PARAM(visit, p, view_points, "points of each view of a step", {4, 65536});
  SEMFIELD_PARAM(visit, p, learning_rate, "at the first step; it falls to a hundredth along half a cosine", {1e-6, 1});
  SEMFIELD_PARAM(visit, p, frequencies,
                 "octaves of sines of a position that the network reads, the lowest as long as the scene", {0, 16});
  SEMFIELD_PARAM(visit, p, hidden_width, "units of a hidden layer", {4, 512});
  SEMFIELD_PARAM(visit, p, hidden_layers, "hidden layers of the network", {1, 8});
  SEMFIELD_PARAM(visit, p, rays, "rays of all training views together that look for the surface", {1000, 1e9});
  SEMFIELD_PARAM(visit, p, points, "points that stand for the surface, about; cells are sized for it", {100, 1e7});
  SEMFIELD_PARAM(visit, p, reach, "distance within which segments are of one object, in the units of the method",
                 {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, neighbours, "segments within reach that make a segment the inside of a cluster", {1, 1e6});
  SEMFIELD_PARAM(visit, p, agree,
                 "share of the sights of two groups of points in one segment from which they are one object", {0, 1});
  SEMFIELD_PARAM(visit, p, least_views, "views that see two groups, from which their segments decide", {1, 1e6});
  SEMFIELD_PARAM(visit, p, least_points, "points of an object; what is smaller is none", {1, 1e9});
  SEMFIELD_PARAM(visit, p, stuff, "names of classes that have no objects");
  SEMFIELD_PARAM(visit, p, seed, "seed of every random value of this phase");
}

void describe(ParamVisitor& visit, SegmentDamage& p) {
  SEMFIELD_PARAM(visit, p, shuffle, "segments of an image get new numbers in random order");
  SEMFIELD_PARAM(visit, p, split, "share of an image's segments that a random line cuts in two", {0, 1});
  SEMFIELD_PARAM(visit, p, merge, "share of an image's segments that are joined with a random neighbour", {0, 1});
  SEMFIELD_PARAM(visit, p, missing, "share of an image's segments that are left out", {0, 1});
  SEMFIELD_PARAM(visit, p, border_px, "borders of segments move by up to so many pixels, in patches of 16", {0, 64});
}

void describe(ParamVisitor& visit, PropagationParams& p) {
  SEMFIELD_PARAM(visit, p, method, "surface: diffusion over neighbouring cells; vote: labels pooled within a cell");
  SEMFIELD_PARAM(visit, p, min_opacity, "opacity of a rendered pixel below which it has no depth", {0.01, 1});
  SEMFIELD_PARAM(visit, p, cell_m,
                 "surface: edge of a cell, m; 0: three pixels at the scene's middle depth, at least 1/500 of its "
                 "longest side; the verb prints it",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, p, color_sigma, "surface: difference of colour (0 to 1) at which a weight falls to exp(-1/2)",
                 {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, normal_sigma,
                 "surface: distance between unit normals (0 to 2) at which a weight falls to exp(-1/2)", {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, vote_weight,
                 "surface: how strongly one labelled pixel holds its cell, where an edge between equal cells is 1",
                 {1e-6, 1e6});
  SEMFIELD_PARAM(visit, p, min_confidence, "pixels whose most probable class is less probable than this stay void",
                 {0, 1});
  SEMFIELD_PARAM(visit, p, vote_cells_m,
                 "vote: edges of cells, ascending; the first with enough votes counts; []: 0.06, 0.12 and 0.2 m, or "
                 "1.2 %, 2.4 % and 4 % of the longest side of a scene that is no room in metres",
                 {1e-12, 1e12});
  SEMFIELD_PARAM(visit, p, least_votes, "vote: how many votes are enough; the largest cell takes what there is",
                 {1, 1e9});
}

void validate(const PropagationParams& p, Diagnostics& diagnostics) {
  if (!std::is_sorted(p.vote_cells_m.begin(), p.vote_cells_m.end(), std::less_equal<>())) {
    diagnostics.error("config.value.order", "propagate.vote_cells_m", "the edges do not ascend",
                      "write the smallest first, each once");
  }
}

}  // namespace semfield
