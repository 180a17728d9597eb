// Results of cells: kept one file per cell, and as rows of results.csv.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "report/sweep/sweep_cells.h"

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

}  // namespace semfield
