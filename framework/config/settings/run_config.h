// A run's configuration as typed sections and plugin slots, read from the composed tree with every error at once.
// The keys of a section are where its struct is: train_settings.h, runtime_settings.h, surface_settings.h and the rooms
// that use them.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "config/explain.h"
#include "config/settings/parts.h"
#include "config/settings/runtime_settings.h"
#include "config/settings/surface_settings.h"
#include "config/settings/train_settings.h"
#include "core/error.h"
#include "formats/text_rows.h"
#include "labels/training_labels.h"
#include "model/losses/loss_list.h"
#include "model/optim/adam.h"
#include "model/render_rules.h"
#include "plugin/registry.h"
#include "scene/loading/frame_source.h"

namespace semfield {

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

/// By key path, for the reference.
std::vector<SectionDoc> describe_sections();

}  // namespace semfield
