// A sweep as written: experiments, each a grid of differences over a base configuration, on scenes, with seeds.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "config/compose.h"
#include "plugin/registry.h"

namespace semfield {

/// Fusing the training labels over views instead of training a field.
struct FuseCell {
  std::string method;  ///< monocular, bayesian or average
  std::string field;   ///< variant whose field gives the depth; empty: the scene's true depth
};

/// Metrics of the labels that trained, as in metrics.jsonl.
inline constexpr std::string_view kGivenPrefix = "given_";
/// Other metrics of training frames, in experiments that score held-out ones.
inline constexpr std::string_view kTrainingPrefix = "training_";

/// A row of an experiment's table.
struct SweepVariant {
  std::string name;
  std::string base;  ///< replaces the scene's configuration file; empty: it does not
  std::vector<ConfigOverride> set;
  std::optional<double> x;      ///< abscissa of the experiment's plot
  std::optional<double> paper;  ///< figure to print beside, of the experiment's paper metric
  std::optional<FuseCell> fuse;
  std::string objects;  ///< variant in whose run objects are found instead of training; empty: this one trains

  bool trains() const { return !fuse && objects.empty(); }
};

struct SweepScene {
  std::string name;
  std::string base;                   ///< configuration file, absolute
  std::vector<ConfigOverride> set;    ///< before the variant's
  std::vector<ConfigOverride> after;  ///< after them: what a variant's step needs to know of this scene
  bool pack = false;  ///< cells read the scene from one packed file, made once: where opening it costs time
};

struct Experiment {
  std::string name, title, note;
  std::string split = "test";        ///< whose frames are scored: test or train
  std::vector<std::string> metrics;  ///< of the table, the first one is plotted
  std::string paper;                 ///< where the paper's figures come from: "Tab. 2, mIoU"
  std::string x_label;
  std::vector<SweepScene> scenes;
  std::vector<ConfigOverride> set;  ///< for every variant
  std::vector<SweepVariant> variants;
  std::vector<std::int64_t> seeds;

  /// Whether a metric is of training frames beside held-out ones: `training_...`, `given_...`.
  bool wants_training_frames() const;
};

struct Sweep {
  std::string name;
  std::vector<Experiment> experiments;
};

/// Reads a sweep file (docs/guide/sweeps.md), or one with a list `sweeps:` of such files whose other keys are merged
/// over each. Throws Error(config) with every error on its own line.
Sweep read_sweep(const std::string& path);

// A JSON schema of sweep files, for editors.

/// Draft 7, indented by two spaces; it refuses the keys that read_sweep refuses.
std::string sweep_schema();

// The cells of a sweep: every run that its tables need, each once however many tables show it.

/// One figure of a table: indices into the sweep.
struct CellUse {
  std::size_t experiment = 0, scene = 0, variant = 0, seed = 0;
};

/// One run. Its id is a hash of all that its result depends on - the resolved configuration, what is scored, how labels
/// are fused - so equal runs of several experiments are one cell, and a changed configuration is another one.
struct Cell {
  std::string id;      ///< 16 hexadecimal digits; the folder's name
  std::string config;  ///< resolved YAML
  std::string split;
  std::string scene;  ///< name, for messages
  std::string pack;   ///< hash of the scene's own section: cells with the same one share a packed file; empty: none
  std::string label;  ///< "experiment / variant", of the first use
  std::int64_t seed = 0;
  FuseCell fuse;           ///< method empty: train, or find objects
  bool objects = false;    ///< find objects in the run of field_cell
  std::string field_cell;  ///< id of the cell whose field gives the depth, or the objects; empty: none
  std::vector<CellUse> uses;

  bool trains() const { return !objects && fuse.method.empty(); }
};

/// Cells in the order of the tables; those that others wait for come first. Seeds go to runtime.seed and
/// scene.labels.seed. Throws Error(config) with every error of every cell's configuration, each named once.
std::vector<Cell> plan_cells(const Sweep& sweep, Registry& registry);

/// `config` with its dataset replaced by `reader` (Registry::pack_reader) of the packed scene `file`; labels and sizes
/// stay.
std::string with_packed_scene(const std::string& config, const std::string& reader, const std::string& file);

}  // namespace semfield
