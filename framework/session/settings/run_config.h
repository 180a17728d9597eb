// A run's configuration as typed sections and plugin slots, read from the composed tree with every error at once.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "config/config_tree.h"
#include "config/params.h"
#include "config/schema.h"
#include "core/error.h"
#include "core/half.h"
#include "formats/text_rows.h"
#include "labels/training_labels.h"
#include "loading/frame_source.h"
#include "losses/loss_list.h"
#include "model/optim/adam.h"
#include "model/render_rules.h"
#include "plugin/registry.h"

namespace semfield {

enum class FusionMethod : std::uint8_t { monocular, bayesian, average };
SEMFIELD_CHOICES(FusionMethod, "monocular", "bayesian", "average");

enum class FusionDepth : std::uint8_t { truth, learned };
SEMFIELD_CHOICES(FusionDepth, "true", "learned");

enum class ViewChoice : std::uint8_t { nearest, even };
SEMFIELD_CHOICES(ViewChoice, "nearest", "even");

struct FusionParams {
  std::vector<std::string> methods{"monocular", "bayesian", "average"};
  FusionDepth depth = FusionDepth::truth;
  double min_opacity = 0.5;
  double tolerance = 0;
  double relative_tolerance = 0;
  double floor = 1e-4;
  int views = 0;
  ViewChoice choose = ViewChoice::nearest;
  int neighbourhood = 1;
  double hard_confidence = 0.7;

  /// Depths `a` and `b` belong to one surface: |a - b| <= tolerance + relative_tolerance * a.
  bool agree(double a, double b) const;
};
void describe(ParamVisitor& visit, FusionParams& params);
void validate(const FusionParams& params, Diagnostics& diagnostics);

/// Methods by name, each once, in the order given. Throws Error(config) naming one that does not exist.
std::vector<FusionMethod> fusion_methods(const std::vector<std::string>& names);

// The section `objects`: how segments of images become objects. Declared here, where sections are read; used in
// objects/.

struct ObjectsParams {
  std::int64_t steps = 1500;
  std::int64_t views = 8;
  std::int64_t view_points = 256;
  double learning_rate = 1e-2;
  std::int64_t frequencies = 9;
  std::int64_t hidden_width = 64;
  std::int64_t hidden_layers = 2;
  std::int64_t rays = 1'500'000;
  std::int64_t points = 200'000;
  double reach = 0.25;
  std::int64_t neighbours = 4;
  double agree = 0.5;
  std::int64_t least_views = 1;
  std::int64_t least_points = 20;
  std::vector<std::string> stuff{"wall", "floor", "ceiling"};
  std::uint32_t seed = 1;
};
void describe(ParamVisitor& visit, ObjectsParams& params);

/// Shares from 0 to 1; all of it happens in each image for itself.
struct SegmentDamage {
  bool shuffle = false;        ///< segments get new numbers in random order
  double split = 0;            ///< segments cut in two along a random line through their middle
  double merge = 0;            ///< segments joined with a random neighbour
  double missing = 0;          ///< segments that are not there
  std::int64_t border_px = 0;  ///< borders are moved by up to so many pixels, in patches

  bool any() const { return shuffle || split > 0 || merge > 0 || missing > 0 || border_px > 0; }
};
void describe(ParamVisitor& visit, SegmentDamage& damage);

// The section `propagate`: how labels spread over a learned surface. Declared here, where sections are read; used in
// surface/fuse/.

enum class PropagationMethod : std::uint8_t { surface, vote };
SEMFIELD_CHOICES(PropagationMethod, "surface", "vote");

struct PropagationParams {
  PropagationMethod method = PropagationMethod::surface;
  double min_opacity = 0.5;
  double cell_m = 0;
  double color_sigma = 0.04;
  double normal_sigma = 0.25;
  double vote_weight = 1;
  double min_confidence = 0;
  std::vector<double> vote_cells_m;
  double least_votes = 8;
};
void describe(ParamVisitor& visit, PropagationParams& params);
void validate(const PropagationParams& params, Diagnostics& diagnostics);

/// automatic: the labels decide when a session opens (session/settings/choices.h).
enum class RaySourceKind : std::uint8_t { all_images, one_image, label_balanced, automatic };
SEMFIELD_CHOICES(RaySourceKind, "all_images", "one_image", "label_balanced", "auto");

struct TrainParams {
  std::int64_t steps = 20000;
  double time_s = 0;
  std::int64_t rays = 1024;
  RaySourceKind ray_source = RaySourceKind::all_images;
  double labelled_share = 0.5;
  bool label_rays_teach_color = true;
};
void describe(ParamVisitor& visit, TrainParams& params);
void validate(const TrainParams& params, Diagnostics& diagnostics);

/// What is believed of training cameras: as given, or learned with the field (model/camera_corrections.h). `automatic`
/// is decided by the scene (choices.h).
enum class CameraTrust : std::uint8_t { given, learned, automatic };
SEMFIELD_CHOICES(CameraTrust, "given", "learned", "auto");
struct CameraParams {
  CameraTrust poses = CameraTrust::given, colors = CameraTrust::given;
  double pose_rate = 0.02;
  double color_rate = 0.02;
  double from_step = 0.1;
};
void describe(ParamVisitor& visit, CameraParams& params);

/// Rounds of self-training (session/self_training.h).
struct SelfTrainingParams {
  std::vector<double> at;
  double confidence = 0.9;
  double min_opacity = 0.5;
};
void describe(ParamVisitor& visit, SelfTrainingParams& params);
void validate(const SelfTrainingParams& params, Diagnostics& diagnostics);

SEMFIELD_CHOICES(Precision, "fp32", "bf16", "auto");

struct RuntimeParams {
  std::string device = "auto";  ///< or what device_of reads (core/view.h)
  Precision precision = Precision::fp32;
  bool deterministic = false;
  int threads = 0;
  std::uint32_t seed = 1;
  int lanes = 0;
  int tile_rays = 0;
  std::vector<std::string> keep;
  double memory_gb = 0;
  bool fold_feature_layer = true;
  bool direction_once_per_ray = true;
  bool deferred_class_layer = true;
};
void describe(ParamVisitor& visit, RuntimeParams& params);
void validate(const RuntimeParams& params, Diagnostics& diagnostics);

struct ReportParams {
  std::int64_t log_every_steps = 20;
  double eval_every_s = 10;
  int eval_frames = 4;
  double eval_share = 0.1;
  double checkpoint_every_s = 60;
  int keep_checkpoints = 2;
  int strips = 4;
  int training_frames = 0;
  int worst_frames = 2;
};
void describe(ParamVisitor& visit, ReportParams& params);

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
void describe(ParamVisitor& visit, BranchRules& rules);

/// What a pass's semantic branch is beside its plugins (model/render_rules.h).
struct SemanticBranchConfig : BranchConfig {
  std::string key = "semantic";  ///< below its pass: "semantic.few" when it is one of several
  LabelKind labels = LabelKind::any;
};
/// All but the plugins.
void describe(ParamVisitor& visit, SemanticBranchConfig& branch);

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
void describe(ParamVisitor& visit, HeadChannel& channel);
/// A head beside that of class logits, behind a branch of the last pass.
struct HeadConfig : HeadChannel, BranchConfig {
  HeadConfig() { rules.reads_feature = false; }  // so that nothing else is computed otherwise for it
  std::string key;                               ///< as `--set` takes it: "heads.0"
  PluginSlot head;
};

struct RunConfig {
  std::string name;
  std::string base_dir;  ///< where relative paths of plugins start that no file anchors; absolute
  PluginSlot dataset;
  LabelConfig labels;
  SceneLoadOptions load;
  SemanticsParams semantics;
  std::vector<HeadConfig> heads;
  std::vector<LossEntry> losses;
  RenderingParams rendering;
  std::vector<PassConfig> passes;
  TrainParams train;
  CameraParams cameras;
  SelfTrainingParams self_training;
  AdamParams adam;
  ScheduleParams schedule;
  RuntimeParams runtime;
  ReportParams report;
  FusionParams fuse;
  PropagationParams propagate;
  ObjectsParams objects;
  SegmentDamage segment_damage;
  PluginSlot grouping;  ///< objects.method; empty: the usual one
  InputLimits limits;
  std::vector<std::string> plugins;  ///< loaded modules, absolute paths
};

/// Loads the modules that `plugins:` names into `registry` (load_listed_module), then reads every section. Collects all
/// errors in `diagnostics`.
RunConfig read_run_config(const ConfigNode& tree, Registry& registry, Diagnostics& diagnostics);

/// compose + read; throws Error(config) with every error on its own line.
RunConfig load_run_config(const std::string& path, const std::vector<std::string>& overrides, Registry& registry);

/// read; throws Error(config) with every error on its own line.
RunConfig run_config_of(const ConfigNode& tree, Registry& registry);

/// The resolved configuration: every parameter written out, absolute base_dir; reading it gives the same run.
ConfigNode resolved_config(const RunConfig& config);

/// Fixed sections by key path, for the reference; with plugins every key, for the schema.
std::vector<SchemaSection> describe_sections(const Registry* plugins = nullptr);

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
}  // namespace semfield
