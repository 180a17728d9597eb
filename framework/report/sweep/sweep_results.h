// Results of cells: kept one file per cell, and as rows of results.csv.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "report/sweep/sweep_file.h"

namespace semfield {

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
/// Values of `semfield fuse --json` for `method`.
CellValues values_of_fusion(const std::string& json, const std::string& method);
/// Figures of `semfield objects --score --json`, then its seconds as `objects_s` and, of each part, `surface_s`, ...
CellValues values_of_objects(const std::string& json);

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

// What one of several processes of a sweep takes of its host: cores and devices.

/// Cells at a time of a process that may run on `own` of its host's `cores`, which `processes` of the sweep share, with
/// `threads` for each cell; at least 1.
int cells_at_a_time(int own, int cores, int processes, int threads);

/// Devices of the `rank`-th of `size` processes on one host: every size-th, from the rank-th on. So each belongs to one
/// process, and none is left over.
std::vector<std::string> devices_of_process(const std::vector<std::string>& devices, int rank, int size);

/// The device for the next cell: the first that is not in `busy`, "" where all are.
std::string free_device(const std::vector<std::string>& devices, const std::vector<std::string>& busy);

/// Names of devices as `runtime.device` takes them, from "0" or "cuda:0". Throws Error(usage) for anything else and for
/// one named twice.
std::vector<std::string> device_names(const std::vector<std::string>& words);

}  // namespace semfield
