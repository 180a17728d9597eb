#include "config/settings/parts.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <initializer_list>

#include "config/config_words.h"
#include "config/settings/run_config.h"
#include "core/files.h"
#include "labels/clicks.h"
#include "model/optim/adam.h"
#include "model/pass.h"
#include "plugin/loader.h"

namespace semfield {

namespace {

// Channels that the framework makes or reads itself.
constexpr std::array kTaken{channel::color,   channel::label,  channel::soft_label, channel::depth, channel::alpha,
                            channel::opacity, channel::weight, channel::sigma,      channel::logits};

// Reads what of a tree is no parameter of a fixed section; every fault becomes a finding.
class Reading {
 public:
  Reading(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics)
      : tree_(tree),
        registry_(registry),
        config_(config),
        diagnostics_(diagnostics),
        of_a_run_(!config.base_dir.empty()) {}

  void all() {
    legs();
    click_file();
    if (const ConfigNode* method = tree_.given("objects.method"))
      config_.grouping = slot(PluginKind::grouping, *method, "objects.method");
    heads();
    losses();
    check_heads_of_losses();
    passes();
  }

  void scene() {
    const ConfigNode* written = tree_.find("scene");
    if (written == nullptr)
      return error("config.key.missing", tree_, "scene: section is missing",
                   "name a dataset: scene: {type: TYPE, ...}, TYPE one of " + one_of(PluginKind::dataset));
    // By convention these keys of a scene are paths.
    config_.dataset =
        slot(PluginKind::dataset, anchored(*written, {"root", "file", "classes"}), "scene", {"labels", "load"});
    if (const ConfigNode* labels = tree_.find_path("scene.labels"); labels != nullptr && labels->is_map())
      label_steps();
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
  template <class Read>
  void items(const std::string& path, const std::string& of, const std::string& remedy, const Read& read) {
    read_items(tree_, path, of, remedy, diagnostics_, read);
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

  std::string one_of(PluginKind kind) const { return join(registry_.names(kind)); }

  void label_steps() {
    LabelConfig& labels = config_.labels;
    if (const ConfigNode* from = tree_.given("scene.labels.from")) {
      const PluginSlot reader =
          sound_slot(PluginKind::label_reader, anchored(*from, {"folder", "file", "classes"}), "scene.labels.from");
      if (reader.entry != nullptr) labels.from = {reader.entry->name, reader.entry->label_reader(*reader.params)};
    }
    items("scene.labels.degrade", "steps {type, ...}",
          "write degrade: [{type: TYPE, ...}], TYPE one of " + one_of(PluginKind::degradation),
          [&](const ConfigNode& item, const std::string& path) {
            const PluginSlot step = sound_slot(PluginKind::degradation, item, path);
            if (step.entry != nullptr)
              labels.degrade.push_back({step.entry->name, step.entry->degradation(*step.params)});
          });
  }

  void legs() {
    std::vector<ScheduleLeg>& legs = config_.schedule.legs;
    items("train.schedule.legs", "maps {start, rate, hold_until, end}",
          "`semfield train --resume RUN --time T` writes it", [&](const ConfigNode& item, const std::string& path) {
            ScheduleLeg leg;
            const int errors = diagnostics_.error_count();
            read_params(item, path, described(leg), diagnostics_);
            const bool last = &item == &tree_.find_path("train.schedule.legs")->items().back();
            if (diagnostics_.error_count() == errors &&
                ((!legs.empty() && leg.start <= legs.back().start) || (leg.end == 0 ? !last : leg.end < leg.start)))
              error("config.schedule.legs", item, path + ": the leg does not follow on the one before",
                    "legs start one after the other, and only the last may have no end yet");
            legs.push_back(leg);
          });
  }

  // The path of the key `clicks` becomes absolute. In a run.yaml a relative one starts at the run's folder; an absolute
  // one of the run's own file gives way to that file where it lies next to the run.yaml.
  void click_file() {
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

  template <class Pass>
  void slots(const ConfigNode& node, const std::string& path, Pass& pass) {
    each_slot_of(pass, [&](const char* key, PluginKind kind, PluginSlot& of_pass, bool required) {
      if (const ConfigNode* plugin = node.given(key)) {
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
    items("heads", "heads {type, channel, branch, ...}", "write heads: [{type: TYPE, channel: NAME, branch: {...}}]",
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
    if (const ConfigNode* own = item.given("branch")) {
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
    items("losses", "terms {type, ...}", "write losses: [{type: distortion, weight: 0.002}]",
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
      if (const ConfigNode* own = item.given("semantic")) pass.semantic = branches(*own, path + ".semantic");
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

  const ConfigNode& tree_;
  const Registry& registry_;
  RunConfig& config_;
  Diagnostics& diagnostics_;
  bool of_a_run_;  // the tree is a run.yaml
};

// {type, every parameter}.
ConfigNode typed_config(const std::string& type, const Describe& describe) {
  const ConfigNode params = params_to_config(describe);
  ConfigNode node = ConfigNode::make_map({{"type", ConfigNode::make_scalar(type, false, {})}}, {});
  node.entries().insert(node.entries().end(), params.entries().begin(), params.entries().end());
  return node;
}

template <class Pass>
void write_slots(ConfigNode& node, const Pass& pass) {
  each_slot_of(pass, [&](const char* key, PluginKind, const PluginSlot& slot, bool) {
    if (slot.entry != nullptr) node.set(key, slot_config(slot));
  });
}

// The parameters that `own` describes, and {position, field}.
ConfigNode branch_config(const BranchConfig& branch, const Describe& own) {
  ConfigNode node = params_to_config(own);
  write_slots(node, branch);
  return node;
}

ConfigNode head_config(const HeadConfig& head) {
  ConfigNode node = slot_config(head.head);
  HeadChannel copy = head;
  const ConfigNode channel = params_to_config(described(copy));
  for (const auto& [key, value] : channel.entries()) node.set(key, value);
  BranchRules rules = head.rules;
  node.set("branch", branch_config(head, described(rules)));
  return node;
}

ConfigNode pass_config(const PassConfig& pass) {
  ConfigNode node = ConfigNode::make_map({{"name", ConfigNode::make_scalar(pass.name, true, {})}}, {});
  write_slots(node, pass);
  ConfigNode branches = ConfigNode::list_of(pass.semantic, [](const SemanticBranchConfig& branch) {
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

ConfigNode slot_config(const PluginSlot& slot) { return typed_config(slot.entry->name, described(*slot.params)); }

void read_scene(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics) {
  Reading(tree, registry, config, diagnostics).scene();
}

void read_parts(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics) {
  Reading(tree, registry, config, diagnostics).all();
}

bool load_modules(const ConfigNode& tree, Registry& registry, Diagnostics& diagnostics) {
  bool loaded = true;
  read_items(tree, "plugins", "module files", {}, diagnostics, [&](const ConfigNode& item, const std::string&) {
    loaded &= noting(diagnostics, item.location().text(), [&] { load_listed_module(registry, resolve_path(item)); });
  });
  return loaded;
}

void write_parts(const RunConfig& config, ConfigNode& tree) {
  const auto leg_config = [](ScheduleLeg leg) { return params_to_config(described(leg)); };
  if (!config.schedule.legs.empty())
    tree.set_path("train.schedule.legs", ConfigNode::list_of(config.schedule.legs, leg_config));
  const LabelConfig& labels = config.labels;
  if (labels.from.reader)
    tree.set_path("scene.labels.from", typed_config(labels.from.type, described(*labels.from.reader)));
  if (!labels.degrade.empty())
    tree.set_path("scene.labels.degrade", ConfigNode::list_of(labels.degrade, [](const LabelConfig::Step& step) {
                    return typed_config(step.type, described(*step.degradation));
                  }));
  if (config.grouping.entry != nullptr) tree.set_path("objects.method", slot_config(config.grouping));
  if (!config.heads.empty()) tree.set("heads", ConfigNode::list_of(config.heads, head_config));
  if (!config.losses.empty())
    tree.set("losses", ConfigNode::list_of(config.losses, [](const LossEntry& entry) {
               return typed_config(entry.type, described(*entry.params));
             }));
  tree.set("passes", ConfigNode::list_of(config.passes, pass_config));
}

void document_parts(std::vector<SectionDoc>& docs) {
  ScheduleLeg leg;
  docs.push_back({"train.schedule.legs[]",
                  "written by runs that continue beyond their first length: a list of what they train then",
                  describe_params(described(leg))});
  SemanticBranchConfig branch;
  docs.push_back({"passes[].semantic",
                  "a network of its own for semantics, besides its plugins `position` and `field`, or a list of them "
                  "from which the training labels choose; without this section the head reads the pass's field",
                  describe_params(described(branch))});
  HeadConfig head;
  docs.push_back({"heads[]",
                  "heads in addition to that of class logits: each makes a channel that losses and renderings read",
                  describe_params(described<HeadChannel>(head))});
  docs.push_back({"heads[].branch", "the head's own network, besides its plugins `position` and `field`",
                  describe_params(described(head.rules))});
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
  if (!noting(diagnostics, type->location().text(), [&] { slot.entry = &registry.get(kind, type->text()); }))
    return slot;
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

}  // namespace semfield
