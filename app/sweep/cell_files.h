// What cells of a sweep leave in its folder, by which the processes of the sweep show each other how far they are.
#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include "report/sweep/sweep_results.h"

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

}  // namespace semfield::app
