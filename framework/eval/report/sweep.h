// A sweep as written: experiments, each a grid of differences over a base configuration, on scenes, with seeds; its
// cells, their results, one file each, and the tables of them.
#pragma once

#include <compare>
#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "config/config_words.h"
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
};

struct Experiment {
  std::string name, title, note;
  std::string split = "test";        ///< whose frames are scored: test or train
  std::vector<std::string> metrics;  ///< of the table, the first one is plotted
  std::string paper;                 ///< where the paper's figures come from: "Tab. 2, mIoU"
  std::string x_label;
  std::vector<std::string> use_scenes;  ///< names of those that are read; empty: all
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

// The cells of a sweep: every run that its tables need, each once however many tables show it.

/// One figure of a table: indices into the sweep.
struct CellUse {
  std::size_t experiment = 0, scene = 0, variant = 0, seed = 0;
  auto operator<=>(const CellUse&) const = default;  ///< in the order of the tables
};

/// One run. Its id is a hash of all that its result depends on - the resolved configuration, what is scored, how labels
/// are fused - so equal runs of several experiments are one cell, and a changed configuration is another one.
struct Cell {
  std::string id;      ///< 16 hexadecimal digits; the folder's name
  std::string config;  ///< resolved YAML
  std::string split;
  std::string scene;  ///< name, for messages
  std::string label;  ///< "experiment / variant", of the first use
  std::int64_t seed = 0;
  FuseCell fuse;           ///< method empty: train, or find objects
  bool objects = false;    ///< find objects in the run of field_cell
  std::string field_cell;  ///< id of the cell whose field gives the depth, or the objects; empty: none
  std::vector<CellUse> uses;

  bool trains() const { return !objects && fuse.method.empty(); }
};

/// Of its configuration, split and fusion.
std::string id_of_cell(const Cell& cell);

/// Cells in the order of the tables; those that others wait for come first. Seeds go to runtime.seed and
/// scene.labels.seed. Throws Error(config) with every error of every cell's configuration, each named once.
std::vector<Cell> plan_cells(const Sweep& sweep, Registry& registry);

/// Metric and value, in the order written; a metric without data is absent.
using CellValues = std::vector<std::pair<std::string, double>>;

/// Finished cells by id.
using SweepResults = std::map<std::string, CellValues>;

/// cells/<id>/result.json, written atomically: its presence says that the cell is done.
void write_cell_result(const std::string& path, const CellValues& values);
/// None without the file. Throws Error(data) naming a damaged one.
std::optional<CellValues> read_cell_result(const std::string& path);

/// Values of a finished training: the last whole evaluation of `split` in metrics.jsonl; beside held-out frames those
/// of training frames, where they were scored, as `given_...` and `training_...`; then seconds and steps of training.
/// Throws Error(data) when the file holds none.
CellValues values_of_run(const std::string& metrics_path, const std::string& split);
/// Values of `semfield labels fuse --json` for `method`.
CellValues values_of_fusion(const std::string& json, const std::string& method);
/// Figures of `semfield objects --score --json`, then its seconds as `objects_s` and, of each part, `surface_s`, ...
CellValues values_of_objects(const std::string& json);

/// "experiment,scene,variant,seed" of a figure.
std::string use_csv(const Sweep& sweep, const CellUse& use);
/// results.csv: experiment, scene, variant, seed, metric, value - a line for every value of every finished cell that a
/// table uses, in the order of the sweep.
std::string results_csv(const Sweep& sweep, const std::vector<Cell>& cells, const SweepResults& results);

// Tables and plots of a sweep: means over seeds with 95 % intervals, beside the paper's figures.

/// Mean of n values and the half width of its 95 % interval, t(0.975, n - 1) s / sqrt(n) [Student08]; the half width is
/// 0 for n < 2.
struct MeanInterval {
  double mean = 0, half_width = 0;
  int n = 0;
};
MeanInterval mean_interval(const std::vector<double>& values);

/// 0.975 quantile of Student's t distribution with `freedom` >= 1 degrees of freedom, to 1e-9.
double student_t975(int freedom);

/// What a reader calls a metric of metrics.jsonl.
std::string metric_label(const std::string& metric);
/// Rows of a table in Markdown, the heads first.
std::string markdown_table(const std::vector<std::vector<std::string>>& rows);

/// The figures behind a table of one experiment.
class ExperimentTable {
 public:
  ExperimentTable(const Sweep& sweep, std::size_t experiment, const std::vector<Cell>& cells,
                  const SweepResults& results);

  /// Over the seeds of one scene; n = 0 without a finished cell.
  MeanInterval at(std::size_t scene, std::size_t variant, const std::string& metric) const;
  /// Over scenes: the mean of the scenes' means, its interval from the seeds' alone, 0 where a scene has one seed;
  /// n = scenes with data.
  MeanInterval over_scenes(std::size_t variant, const std::string& metric) const;

  /// Why the variants cannot be compared: they were scored on other frames or pixels of a scene. "" where they can.
  const std::string& unequal() const { return unequal_; }
  /// A heading, the note, and a table per metric: a row per variant, a column per scene, their mean, the paper's
  /// figure. What cannot be compared has the reason in the place of tables.
  std::string markdown() const;
  /// variant, scene, metric, n, mean, half_width; no rows where they cannot be compared.
  std::string csv() const;
  /// For report_page: what markdown() says, and the first metric over `x`, a line per scene; without a plot when fewer
  /// than two variants have an x, or they cannot be compared.
  std::string json() const;

 private:
  std::vector<std::vector<std::string>> rows_of(const std::string& metric, bool with_paper) const;
  std::vector<std::vector<std::vector<std::string>>> tables() const;  // [metric][row, first the heads][cell]
  std::string scored_text() const;
  void note_unequal(const CellUse& use, const CellValues& values);
  const Experiment& experiment_;
  std::vector<CellValues> scored_;  // [scene] frames and pixels of its first run
  std::string unequal_;
  std::vector<std::vector<std::vector<const CellValues*>>> values_;  // [scene][variant][seeds done]
};

/// Names of devices as `runtime.device` takes them, from "0" or "cuda:0". Throws Error(usage) for anything else and for
/// one named twice.
std::vector<std::string> device_names(const std::vector<std::string>& words);

}  // namespace semfield
