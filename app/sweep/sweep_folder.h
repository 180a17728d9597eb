// The folder of a sweep, in which several processes of one sweep may be at work, on one machine or on several.
#pragma once

#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "report/sweep/sweep_file.h"
#include "report/sweep/sweep_results.h"
#include "system/files.h"

namespace semfield::app {

/// FOLDER/cells/ID.
std::string cell_folder(const std::string& sweep_folder, const std::string& id);

/// Result of a finished cell, from its result.json.
std::optional<CellValues> result_of_cell(const std::string& sweep_folder, const std::string& id);

/// failure.txt: why a cell failed since the sweep began. Nobody tries it again in this sweep, the next sweep does.
void write_cell_failure(const std::string& sweep_folder, const std::string& id, const std::string& failure);
/// Throws write_error where the file cannot be removed.
void forget_cell_failure(const std::string& sweep_folder, const std::string& id);

/// Cells that ended, whoever ran them.
struct EndedCells {
  SweepResults results;
  std::map<std::string, std::string> failures;  ///< why, by cell

  bool has(const std::string& id) const { return results.contains(id) || failures.contains(id); }
};

/// Looks whether a cell has ended, unless that is known. Returns whether it has. Throws Error(data) naming a damaged
/// result.
bool notice_cell(EndedCells& ended, const std::string& sweep_folder, const std::string& id);

/// A sentence for the user.
using SweepNote = std::function<void(const std::string&)>;

/// Takes the lock of `folder`, which is created where it is missing, as soon as nobody else has it; `note` is called
/// once for whom it waits. A stop signal that was received while others have it ends the wait, and the lock is not held
/// then. Throws write_error where the folder cannot be written.
FolderLock lock_when_free(const std::string& folder, const SweepNote& note);

/// A process's part in the work on a sweep's folder. FOLDER/.lock is held for moments, while files of the whole sweep
/// are written; FOLDER/cells/.lock is shared by all processes that are at work, for as long as they are.
class SweepFolder {
 public:
  /// Joins the work, or begins it where nobody else is there: cells that failed before may then be tried again. Throws
  /// Error(cannot_create) where processes of another sweep, one with other cells, are at work.
  SweepFolder(std::string path, const Sweep& sweep, const std::vector<Cell>& cells, SweepNote note);

  const std::string& path() const { return path_; }
  /// "process 4711 on HOST", which joined last, where others were at work already; else "".
  const std::string& beside() const { return beside_; }

  /// Notices what ended since and writes the tables of all results, those files that change. After a stop signal tables
  /// that others are writing are left to them.
  void write_tables(EndedCells& ended) const;

 private:
  void begin();
  std::string path_, beside_;
  const Sweep& sweep_;
  const std::vector<Cell>& cells_;
  SweepNote note_;
  FolderLock at_work_;
};

}  // namespace semfield::app
