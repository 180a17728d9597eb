// Cells of a sweep as processes of this program, some at a time.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "app/sweep/sweep_folder.h"

namespace semfield::app {

struct PoolOptions {
  std::string folder;                ///< of the sweep: holds cells/<id>/
  std::string program;               ///< whose verbs train and fuse: own_program()
  int jobs = 1;                      ///< cells at a time
  int threads = 1;                   ///< of each
  double memory_gb = 0;              ///< of all together; 0: of what the machine has available, this process's part
  int processes_of_host = 1;         ///< of the sweep, which share what is available
  std::vector<std::string> devices;  ///< by the names of runtime.device: a cell at a time on each; none: as cells say
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
  std::function<void(const CellOutcome&)> finished;   ///< after each cell that ran here
  std::function<void(const std::string&)> waits_for;  ///< a sentence: whose cell is waited for when none is left to run
};

/// Runs every cell that has not ended (a result.json or a failure.txt), in order. A cell whose run was stopped resumes
/// from its checkpoint, one that failed in an earlier sweep starts anew. A cell's folder is locked by its process, so
/// one that another process of the sweep has, or that a killed sweep's process still has, is passed over, and waited
/// for in the end: it is taken up here where it was left unfinished. A failed cell does not stop the others. Cells that
/// end, here or elsewhere, are added to `ended`. Ends early, with the children's checkpoints written, when a stop
/// signal comes; returns false then.
bool run_cells(const std::vector<Cell>& cells, const PoolOptions& options, EndedCells& ended, const PoolHooks& hooks);

/// The packed copy of a cell's scene (Cell::pack), absolute.
std::string pack_file(const std::string& sweep_folder, const Cell& cell);

}  // namespace semfield::app
