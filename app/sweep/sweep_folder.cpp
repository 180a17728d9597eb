#include "app/sweep/sweep_folder.h"

#include <fmt/format.h>

#include <cerrno>
#include <chrono>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string_view>
#include <thread>
#include <utility>

#include "app/json_output.h"
#include "app/signals.h"
#include "formats/text_rows.h"
#include "report/report.h"
#include "report/sweep/sweep_results.h"
#include "system/files.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

std::string file_of_cell(const std::string& sweep_folder, const std::string& id, const char* name) {
  return (fs::path(cell_folder(sweep_folder, id)) / name).string();
}

constexpr const char* kResult = "result.json";
constexpr const char* kFailure = "failure.txt";

}  // namespace

std::string cell_folder(const std::string& sweep_folder, const std::string& id) {
  return (fs::path(sweep_folder) / "cells" / id).string();
}

std::optional<CellValues> result_of_cell(const std::string& sweep_folder, const std::string& id) {
  return read_cell_result(file_of_cell(sweep_folder, id, kResult));
}

void write_cell_failure(const std::string& sweep_folder, const std::string& id, const std::string& failure) {
  write_file_atomic(file_of_cell(sweep_folder, id, kFailure), failure + "\n");
}

void forget_cell_failure(const std::string& sweep_folder, const std::string& id) {
  const std::string file = file_of_cell(sweep_folder, id, kFailure);
  std::error_code failed;
  fs::remove(file, failed);
  if (failed) throw write_error("remove", file, failed.value());
}

bool notice_cell(EndedCells& ended, const std::string& sweep_folder, const std::string& id) {
  if (ended.has(id)) return true;
  bool done = false, failed = false;
  // By listing the folder: on NFS this queries the server, which looking for a file need not do for a minute.
  std::error_code not_there;
  for (const fs::directory_entry& entry : fs::directory_iterator(cell_folder(sweep_folder, id), not_there)) {
    done = done || entry.path().filename() == kResult;
    failed = failed || entry.path().filename() == kFailure;
  }
  if (done) {
    if (std::optional<CellValues> values = result_of_cell(sweep_folder, id)) ended.results[id] = std::move(*values);
  } else if (failed) {
    std::string failure = read_text_file(file_of_cell(sweep_folder, id, kFailure));
    if (failure.ends_with('\n')) failure.pop_back();
    ended.failures[id] = std::move(failure);
  }
  return ended.has(id);
}

namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

constexpr std::chrono::milliseconds kLockLook{10};   // between two attempts at a lock
constexpr std::chrono::seconds kPatience{2};         // before the user hears of a wait
constexpr std::chrono::milliseconds kLastWait{500};  // after a stop signal

// A file that stays as it is costs no disk write, however many processes write the same tables.
void write_if_changed(const fs::path& file, std::string_view text) {
  if (fs::exists(file) && read_text_file(file.string()) == text) return;
  write_file_atomic(file.string(), text);
}

// Which folder holds which cell, for people, and what the processes of a sweep have in common.
std::string index_csv(const Sweep& sweep, const std::vector<Cell>& cells) {
  std::string text = "cell,experiment,scene,variant,seed\n";
  for (const Cell& cell : cells) {
    for (const CellUse& use : cell.uses) {
      const Experiment& e = sweep.experiments[use.experiment];
      text += fmt::format("{},{},{},{},{}\n", cell.id, csv_field(e.name), csv_field(e.scenes[use.scene].name),
                          csv_field(e.variants[use.variant].name), e.seeds[use.seed]);
    }
  }
  return text;
}

}  // namespace

FolderLock lock_when_free(const std::string& folder, const SweepNote& note) {
  create_folders(folder);
  FolderLock lock;
  const Clock::time_point start = Clock::now();
  bool told = false;
  for (;;) {
    const int cause = lock.take(folder);
    if (cause == 0) return lock;
    if (cause != EWOULDBLOCK) throw write_error("lock", folder, cause);
    const Clock::duration waited = Clock::now() - start;
    if (stop_signal() != 0 && waited > kLastWait) return lock;
    if (waited > kPatience && !told) {
      told = true;
      note(fmt::format("{}: waiting for {}, which writes there", folder, lock.holder()));
    }
    std::this_thread::sleep_for(kLockLook);
  }
}

SweepFolder::SweepFolder(std::string path, const Sweep& sweep, const std::vector<Cell>& cells, SweepNote note)
    : path_(std::move(path)), sweep_(sweep), cells_(cells), note_(std::move(note)) {
  const FolderLock alone = lock_when_free(path_, note_);
  remove_stale_temporaries(path_);
  const std::string folder = (fs::path(path_) / "cells").string();
  create_folders(folder);
  const fs::path index = fs::path(path_) / "cells.csv";
  const std::string own_index = index_csv(sweep_, cells_);
  int cause = at_work_.take(folder);
  if (cause == 0) {
    begin();
  } else if (cause == EWOULDBLOCK) {
    beside_ = at_work_.holder();
    if (fs::exists(index) && read_text_file(index.string()) != own_index)
      throw Error(
          ErrorKind::cannot_create, "sweep.folder.busy",
          fmt::format("the sweep folder '{}' is in use by {}, another sweep with other cells", path_, beside_),
          "wait for it to end, stop it (the next sweep continues from there), or choose another folder with --out; "
          "--dry-run shows which cells are done");
  } else {
    throw write_error("lock", folder, cause);
  }
  write_if_changed(index, own_index);
  // Nobody can have come between: whoever joins holds the lock of the sweep's folder.
  cause = at_work_.share(folder);
  if (cause != 0) throw write_error("lock", folder, cause);
}

void SweepFolder::begin() {
  for (const Cell& cell : cells_) forget_cell_failure(path_, cell.id);
}

void SweepFolder::write_tables(EndedCells& ended) const {
  const FolderLock alone = lock_when_free(path_, note_);
  for (const Cell& cell : cells_) notice_cell(ended, path_, cell.id);
  if (!alone.held()) return;
  std::string page = "# " + sweep_.name + "\n";
  Json data{{"title", sweep_.name}, {"experiments", Json::array()}};
  for (std::size_t e = 0; e < sweep_.experiments.size(); ++e) {
    const ExperimentTable table(sweep_, e, cells_, ended.results);
    const std::string name = sweep_.experiments[e].name;
    page += "\n" + table.markdown();
    data["experiments"].push_back(Json::parse(table.json()));
    if (!table.unequal().empty()) note_("experiment '" + name + "' has no tables: " + table.unequal());
    write_if_changed(fs::path(path_) / (name + ".csv"), table.csv());
  }
  write_if_changed(fs::path(path_) / "tables.md", page);
  write_if_changed(fs::path(path_) / "tables.html", report_page(json_text(data)));
  write_if_changed(fs::path(path_) / "results.csv", results_csv(sweep_, cells_, ended.results));
}

}  // namespace semfield::app
