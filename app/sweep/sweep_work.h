// The work on a sweep: its folder, in which several processes may be busy, on one machine or on several, and its
// cells, of which each process runs one at a time.
#pragma once

#include <deque>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "app/child_process.h"
#include "core/files.h"
#include "core/non_copyable.h"
#include "eval/report/sweep.h"
#include "plugin/registry.h"
#include "train/run.h"

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
  /// Joins the work, or begins it where nobody else is there: cells that failed before may then be tried again. Whoever
  /// `helps` one that has joined does neither. Throws Error(cannot_create) where processes of another sweep, one with
  /// other cells, are at work.
  SweepFolder(std::string path, const Sweep& sweep, const std::vector<Cell>& cells, SweepNote note, bool helps);

  const std::string& path() const { return path_; }
  /// "process 4711 on HOST", which joined last, where others were at work already; else "".
  const std::string& beside() const { return beside_; }

  /// Notices what ended since and writes the tables of all results, those files that change. After a stop signal tables
  /// that others are writing are left to them.
  void write_tables(EndedCells& ended) const;

 private:
  std::string path_, beside_;
  const Sweep& sweep_;
  const std::vector<Cell>& cells_;
  SweepNote note_;
  FolderLock at_work_;
};

/// With what a process trains cells itself, which load an equal scene once.
struct TrainHere {
  Registry& registry;
  KeptScene kept{};
};

/// How a process runs cells, one at a time.
struct CellOptions {
  std::string folder;   ///< of the sweep: holds cells/<id>/
  std::string program;  ///< whose verbs train and fuse: own_program()
  int threads = 1;      ///< of a cell
  int place = 0;  ///< among the processes that share `memory_gb`: one begins where there is room for those before it
  double memory_gb = 0;  ///< 0: most of what the machine has available
  std::string device;    ///< by the name of runtime.device; "": as cells say
  bool keep_checkpoints = false;
  std::vector<std::string> modules;  ///< files of plugins that cells load
  TrainHere* here = nullptr;         ///< cells, which all train, do so in this process; null: each has one of its own
};

struct CellOutcome {
  const Cell* cell = nullptr;
  std::string failure;  ///< the last line it said, and where the rest stands; "": it is done
  double seconds = 0;
};

struct CellHooks {
  std::function<void(const CellOutcome&)> finished;   ///< after each cell that ran here
  std::function<void(const std::string&)> waits_for;  ///< a sentence: whose cell is waited for when none is left to run
  std::function<int()> stop;                          ///< 0, or the signal that asks for an end
};

/// Runs every cell that has not ended (a result.json or a failure.txt), in order. A cell whose run was stopped resumes
/// from its checkpoint, one that failed in an earlier sweep starts anew. A cell's folder is locked by who runs it, so
/// one that another process of the sweep has, or that a killed sweep's process still has, is passed over, and waited
/// for in the end: it is taken up here where it was left unfinished. A failed cell does not stop the others. Cells that
/// end, here or elsewhere, are added to `ended`. Ends early, with the cell's checkpoint written, when a stop signal
/// comes; returns false then. Throws the error of a GPU that cells in this process have lost.
bool run_cells(const std::vector<Cell>& cells, const CellOptions& options, EndedCells& ended, const CellHooks& hooks);

/// Processes with the words of this one, which work beside it until it ends or stops.
class Helpers : NonCopyable {
 public:
  /// Starts the first to the `count`-th. Throws Error(unavailable) where no process can be had.
  explicit Helpers(int count);
  /// Which of them this process is; 0: none.
  static int own_number();
  /// Asks them to end. To be called as often as one likes.
  void stop();
  /// Whether a sentence names one of them as the "process 4711 on HOST" that it is about.
  bool is_about_one(const std::string& text) const;

 private:
  std::deque<OwnedChild> children_;
  bool stopped_ = false;
};

}  // namespace semfield::app
