// What of a run's configuration is no parameter of a fixed section: modules, the scene with its label files, passes and
// their networks, heads, losses, groupings, legs of the schedule. run_config.cpp has the list of the fixed sections,
// whose keys are where their structs are.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "config/config_tree.h"
#include "config/explain.h"
#include "config/params.h"
#include "core/error.h"
#include "model/losses/loss_list.h"
#include "model/render_rules.h"
#include "plugin/registry.h"
#include "scene/loading/frame_source.h"

namespace semfield {

struct RunConfig;

/// A plugin chosen by `type`, with its parameters read.
struct PluginSlot {
  const PluginEntry* entry = nullptr;  ///< null: the slot is empty
  std::unique_ptr<PluginParams> params;
};

/// Labels that a semantic branch is meant for; choices.h says which a scene has.
enum class LabelKind : std::uint8_t { any, few, noisy, many, dense };
SEMFIELD_CHOICES(LabelKind, "any", "few", "noisy", "many", "dense");

/// A network of its own behind a pass.
struct BranchConfig {
  PluginSlot position, field;
  BranchRules rules;
};

inline void describe(ParamVisitor& visit, BranchRules& p) {
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

/// What a pass's semantic branch is beside its plugins (model/render_rules.h).
struct SemanticBranchConfig : BranchConfig {
  std::string key = "semantic";  ///< below its pass: "semantic.few" when it is one of several
  LabelKind labels = LabelKind::any;
};
/// All but the plugins.
inline void describe(ParamVisitor& visit, SemanticBranchConfig& branch) {
  SEMFIELD_PARAM(
      visit, branch, labels,
      "in a list, the labels that this branch is for; noisy: neighbouring labels often differ; few: fewer than one "
      "training pixel in 500 has a label; dense: half of them or more have one; many: all others, and dense ones "
      "where no earlier branch is for them; any: every kind");
  describe(visit, branch.rules);
}

struct PassConfig {
  std::string name;
  std::string key;  ///< as `--set` takes it: "passes.main"
  PluginSlot sampler, position, direction, field;
  std::vector<SemanticBranchConfig> semantic;  ///< none, one, or several of which the labels choose one
  /// The branch that is built: the first until choose_branches has been asked; null without one.
  const SemanticBranchConfig* branch() const { return semantic.empty() ? nullptr : &semantic.front(); }
};

/// What a head is but for its plugins and its branch.
struct HeadChannel {
  std::string channel;   ///< that it makes; a dataset's channel of this name is what losses compare it with
  int width = 0;         ///< its columns; 0 until the scene is known
  int source_width = 0;  ///< columns of the dataset's channel, of which it learns principal axes; 0: those it has
};

inline void describe(ParamVisitor& visit, HeadChannel& p) {
  SEMFIELD_PARAM(visit, p, channel,
                 "name of the channel that the head makes, and of the dataset's channel that a loss compares with it");
  SEMFIELD_PARAM(visit, p, width,
                 "columns of the channel; fewer than the dataset's has: its principal axes; 0: at most 64 of the "
                 "dataset's",
                 {0, 1024});
  SEMFIELD_PARAM(visit, p, source_width, "columns of the dataset's channel where `width` is smaller; written by a run",
                 {0, 65536});
}

/// A head beside that of class logits, behind a branch of the last pass.
struct HeadConfig : HeadChannel, BranchConfig {
  HeadConfig() { rules.reads_feature = false; }  // so that nothing else is computed otherwise for it
  std::string key;                               ///< as `--set` takes it: "heads.0"
  PluginSlot head;
};

/// Every plugin of a pass or a branch, as see(key, kind, slot, whether it must be there): the one list by which they
/// are read, written and looked through.
template <class Pass, class See>
void each_slot_of(Pass& pass, const See& see) {
  if constexpr (requires { pass.sampler; }) {
    see("sampler", PluginKind::sampler, pass.sampler, true);
    see("position", PluginKind::encoder, pass.position, true);
    see("direction", PluginKind::encoder, pass.direction, false);
    see("field", PluginKind::field, pass.field, true);
  } else {
    see("position", PluginKind::encoder, pass.position, true);
    see("field", PluginKind::field, pass.field, true);
  }
}

/// Columns of a head whose dataset has more for its channel, unless its own `width` says otherwise.
inline constexpr int kUsualHeadWidth = 64;
/// Settles width and source_width of the heads by the channels of the scene's training frames. Throws Error(config) for
/// a head whose width neither says, and for one that is to have more columns than its channel; Error(data) for a
/// channel whose frames differ in columns.
void settle_heads(RunConfig& config, const SceneInfo& scene);

/// The targets that losses cannot do without, each once.
std::vector<std::string> targets_of(const std::vector<LossEntry>& entries);
/// True when one of them has the name.
bool losses_read(const std::vector<LossEntry>& entries, std::string_view target);
/// Depth images of training frames, and their valid pixels.
struct TrainingDepth {
  std::int64_t frames = 0, pixels = 0;
};
TrainingDepth training_depth(const LoadedScene& scene);
/// What training makes of them, as a phrase; "" where there are none and no term asks for them. Warns where a term
/// reads depth images without a valid pixel.
std::string depth_use(const std::vector<LossEntry>& entries, const TrainingDepth& depth, Diagnostics& diagnostics);

/// The plugin that `node` names under 'type', with its parameters; `other_keys` of the map belong to others. Findings
/// go to `diagnostics`, and the slot is then of no use.
PluginSlot read_slot(PluginKind kind, const ConfigNode& node, const std::string& path, const Registry& registry,
                     Diagnostics& diagnostics, const std::vector<std::string>& other_keys = {});

/// {type, every parameter}.
ConfigNode slot_config(const PluginSlot& slot);

// For run_config.cpp, which puts a configuration together.

/// Loads what `plugins` lists. False where a module could not be loaded.
bool load_modules(const ConfigNode& tree, Registry& registry, Diagnostics& diagnostics);
/// The scene's dataset, its label files and degradations. Paths in them become absolute, but for those of a run.yaml.
void read_scene(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics);
/// Everything else; the fixed sections have been read.
void read_parts(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics);
/// Adds them to the resolved configuration.
void write_parts(const RunConfig& config, ConfigNode& tree);
/// Adds what the reference says of them.
void document_parts(std::vector<SectionDoc>& docs);

}  // namespace semfield
