// sweep: experiments as grids of differences, cell by cell, with tables and plots.
#include <fmt/format.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <thread>

#include "app/cell_pool.h"
#include "app/json_output.h"
#include "app/signals.h"
#include "app/verb.h"
#include "compute/parallel.h"
#include "formats/text_rows.h"
#include "sweep/sweep_tables.h"
#include "system/files.h"
#include "system/folder_lock.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

struct SweepOptions {
  std::string file;
  std::string out;  ///< default: runs/<name>
  std::optional<int> jobs, threads;
  std::optional<double> memory_gb;
  bool keep_checkpoints = false;
  bool dry_run = false;
};

std::string minutes_text(double seconds) {
  return seconds < 90 ? fmt::format("{:.0f} s", seconds) : fmt::format("{:.0f} min", seconds / 60);
}

void write_tables(const std::string& out, const Sweep& sweep, const std::vector<Cell>& cells,
                  const SweepResults& results) {
  std::string page = "# " + sweep.name + "\n";
  for (std::size_t e = 0; e < sweep.experiments.size(); ++e) {
    const ExperimentTable table(sweep, e, cells, results);
    const std::string name = sweep.experiments[e].name;
    page += "\n" + table.markdown();
    write_file_atomic((fs::path(out) / (name + ".csv")).string(), table.csv());
    const std::string svg = table.svg();
    if (svg.empty()) continue;
    write_file_atomic((fs::path(out) / (name + ".svg")).string(), svg);
    page += "\n![" + sweep.experiments[e].title + "](" + name + ".svg)\n";
  }
  write_file_atomic((fs::path(out) / "tables.md").string(), page);
  write_file_atomic((fs::path(out) / "results.csv").string(), results_csv(sweep, cells, results));
}

// Which folder holds which cell, for people.
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

// The folder, created where it is missing, for one sweep at a time.
FolderLock lock_of(const std::string& folder) {
  create_folders(folder);
  remove_stale_temporaries(folder);
  FolderLock lock;
  const int cause = lock.take(folder);
  if (cause == EWOULDBLOCK)
    throw Error(
        ErrorKind::cannot_create,
        fmt::format("the sweep folder '{}' is in use by {}, another sweep", folder, lock.holder()),
        "wait for it to end, stop it (the next sweep continues from there), or choose another folder with --out; "
        "--dry-run tells which cells are done");
  if (cause != 0) throw write_error("lock", folder, cause);
  return lock;
}

int run(const SweepOptions& options, AppContext& context) {
  const Sweep sweep = read_sweep(options.file);
  const std::vector<Cell> cells = plan_cells(sweep, context.registry);
  PoolOptions pool;
  pool.folder = options.out.empty() ? "runs/" + sweep.name : options.out;
  pool.threads = std::max(1, options.threads.value_or(1));
  pool.jobs = options.jobs.value_or(std::max(1, thread_count() / pool.threads));
  pool.memory_gb = options.memory_gb.value_or(0);
  pool.keep_checkpoints = options.keep_checkpoints;
  pool.modules = context.registry.module_files();
  if (std::any_of(cells.begin(), cells.end(), [](const Cell& cell) { return !cell.pack.empty(); }))
    pool.pack_reader = context.registry.pack_reader();

  FolderLock lock;
  if (!options.dry_run) lock = lock_of(pool.folder);
  SweepResults results;
  for (const Cell& cell : cells) {
    if (std::optional<CellValues> values = result_of_cell(pool, cell.id)) results[cell.id] = std::move(*values);
  }
  const std::size_t total = cells.size();
  print_note(
      context,
      fmt::format("{}: {} experiments, {} cells, {} of them done; {} at a time with {} threads each, in {}", sweep.name,
                  sweep.experiments.size(), total, results.size(), pool.jobs, pool.threads, pool.folder));
  if (options.dry_run && context.json) {
    Json planned = Json::array();
    for (const Cell& cell : cells)
      planned.push_back({{"cell", cell.id},
                         {"label", cell.label},
                         {"scene", cell.scene},
                         {"seed", cell.seed},
                         {"done", results.contains(cell.id)}});
    print_json(context, {{"folder", pool.folder}, {"planned", planned}});
    return 0;
  }
  if (options.dry_run) {
    for (const Cell& cell : cells)
      std::printf("%s %s, %s, seed %lld%s\n", cell.id.c_str(), cell.label.c_str(), cell.scene.c_str(),
                  static_cast<long long>(cell.seed), results.contains(cell.id) ? " (done)" : "");
    return 0;
  }
  write_file_atomic((fs::path(pool.folder) / "cells.csv").string(), index_csv(sweep, cells));
  int failures = 0;
  std::size_t ran = 0;
  const std::size_t to_run = total - results.size();
  double seconds = 0;
  PoolHooks hooks;
  hooks.note = [&](const std::string& text) { print_note(context, text); };
  hooks.finished = [&](const CellOutcome& outcome) {
    ++ran;
    seconds += outcome.seconds;
    const Cell& cell = *outcome.cell;
    const double left = seconds / static_cast<double>(ran) * static_cast<double>(to_run - ran) / pool.jobs;
    std::string what = outcome.failure;
    if (outcome.done) {
      const std::string& metric = sweep.experiments[cell.uses.front().experiment].metrics.front();
      for (const auto& [name, value] : results.at(cell.id)) {
        if (name == metric) what = fmt::format("{} {:.3f}", metric, value);
      }
    } else {
      ++failures;
    }
    print_note(context, fmt::format("[{}/{}] {}, {}, seed {}: {} ({:.0f} s, {} left)", results.size(), total,
                                    cell.label, cell.scene, cell.seed, what, outcome.seconds, minutes_text(left)));
    write_tables(pool.folder, sweep, cells, results);
  };
  if (results.size() < total) pack_scenes(cells, pool, context.registry, hooks);
  const bool whole = run_cells(cells, pool, results, hooks);
  write_tables(pool.folder, sweep, cells, results);
  if (context.json) {
    print_json(context, {{"folder", pool.folder}, {"cells", total}, {"done", results.size()}, {"failed", failures}});
  } else {
    std::printf("sweep: cells=%zu done=%zu failed=%d folder=%s\n", total, results.size(), failures,
                pool.folder.c_str());
  }
  if (!whole) {
    print_note(context, "stopped; the same command resumes the sweep");
    return 128 + stop_signal();
  }
  return failures > 0 ? static_cast<int>(ErrorKind::failure) : 0;
}

void words(VerbWords& verb, SweepOptions& options) {
  verb.operand("file", options.file, "sweep file (YAML)");
  verb.value("--out FOLDER", options.out,
             "folder of cells and tables (default: runs/<name>); an existing one is resumed");
  verb.value_in("--jobs N", options.jobs, 1, 4096, "cells at a time (default: every core)");
  verb.value_in("--threads N", options.threads, 1, 4096, "threads of each cell (default: 1)");
  verb.positive("--memory GB", options.memory_gb, "GB that all cells together may use (default: 80 % of what is free)");
  verb.flag("--keep-checkpoints", options.keep_checkpoints, "keep the checkpoints of finished cells");
  verb.flag("--dry-run", options.dry_run, "list the cells, then stop");
}

}  // namespace

Verb verb_sweep() {
  return with_json(make_verb("sweep", 50, "run experiments: a grid of differences, scenes and seeds", words, run));
}

}  // namespace semfield::app
