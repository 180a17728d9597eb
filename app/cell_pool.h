// Cells of a sweep as processes of this program, some at a time.
#pragma once

#include <functional>
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
};

/// Packs the scenes that cells share (Cell::pack) into folder/scenes/, those that are not there yet.
void pack_scenes(const std::vector<Cell>& cells, const PoolOptions& options, Registry& registry,
                 const std::function<void(const std::string&)>& note);

struct CellOutcome {
  const Cell* cell = nullptr;
  bool done = false;
  std::string failure;  ///< the last line it said, and where the rest stands
  double seconds = 0;
};

/// Runs every cell without a result.json, in order; a cell whose run was stopped goes on from its checkpoint, one that
/// failed before starts anew. A failed cell does not stop the others. Results are added to `results`; `finished` is
/// called after each. Ends early, with the children's checkpoints written, when a stop signal comes; returns false
/// then.
bool run_cells(const std::vector<Cell>& cells, const PoolOptions& options, SweepResults& results,
               const std::function<void(const CellOutcome&)>& finished);

std::string cell_folder(const PoolOptions& options, const std::string& id);

}  // namespace semfield::app
