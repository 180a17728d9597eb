// Cells of a sweep as processes of this program, some at a time.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "sweep/sweep_results.h"

namespace semfield::app {

struct PoolOptions {
  std::string folder;    ///< holds cells/<id>/
  int jobs = 1;          ///< cells at a time
  int threads = 1;       ///< of each
  double memory_gb = 0;  ///< of all together; 0: what the machine has available
  bool keep_checkpoints = false;
  std::vector<std::string> modules;  ///< files of plugins that cells load
  std::string pack_reader;           ///< Registry::pack_reader, where a cell has a packed scene
};

struct CellOutcome {
  const Cell* cell = nullptr;
  bool done = false;
  std::string failure;  ///< the last line it said, and where the rest stands
  double seconds = 0;
};

struct PoolHooks {
  std::function<void(const CellOutcome&)> finished;  ///< after each cell
  std::function<void(const std::string&)> note;      ///< sentences for the user
};

/// Packs the scenes that cells share (Cell::pack) into folder/scenes/, those that are not there yet or are damaged.
/// The caller holds the folder's lock.
void pack_scenes(const std::vector<Cell>& cells, const PoolOptions& options, Registry& registry,
                 const PoolHooks& hooks);

/// Runs every cell without a result.json, in order; a cell whose run was stopped resumes from its checkpoint, one that
/// failed before starts anew. A cell's folder is locked by its process, so one that a killed sweep's process still has
/// is waited for. A failed cell does not stop the others. Results are added to `results`. Ends early, with the
/// children's checkpoints written, when a stop signal comes; returns false then. The caller holds the folder's lock.
bool run_cells(const std::vector<Cell>& cells, const PoolOptions& options, SweepResults& results,
               const PoolHooks& hooks);

/// Result of a finished cell, from its result.json.
std::optional<CellValues> result_of_cell(const PoolOptions& options, const std::string& id);
std::string cell_folder(const PoolOptions& options, const std::string& id);

}  // namespace semfield::app
