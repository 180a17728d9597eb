#include "app/cell_pool.h"

#include <fmt/format.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <csignal>
#include <deque>
#include <filesystem>
#include <set>
#include <thread>

#include "app/child_process.h"
#include "app/scene/pack_scene.h"
#include "app/signals.h"
#include "core/work_scope.h"
#include "loading/packed_scene.h"
#include "settings/run_config.h"
#include "system/files.h"
#include "system/folder_lock.h"
#include "system/memory_limit.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

using Clock = std::chrono::steady_clock;

constexpr double kFirstGuess_gb = 1;  // of a cell, until one has ended

double available_memory_gb() {
  const std::size_t bytes = available_memory();
  return bytes == kNoMemoryLimit ? 4 : static_cast<double>(bytes) / (1 << 30);
}

// Absolute: a run's configuration must hold from any working folder.
fs::path pack_file(const PoolOptions& options, const Cell& cell) {
  return fs::absolute(fs::path(options.folder) / "scenes" / (cell.pack + ".sfpack"));
}

// A packed copy whose header and list of frames are whole. Cells check what they read of it.
bool is_packed(const std::string& file, const PoolHooks& hooks) {
  if (!fs::exists(file)) return false;
  try {
    const PackedScene scene(file);
    return true;
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::data) throw;
    hooks.note(error.message());
    return false;
  }
}

struct Child {
  FolderLock lock;  // of the cell's folder; shared with the process, so that it outlives a killed sweep
  pid_t pid = 0;
  const Cell* cell = nullptr;
  Clock::time_point start;
  bool resumed = false;  // went on from a checkpoint: what it used is not all that the cell took
};

class Pool {
 public:
  Pool(const PoolOptions& options, SweepResults& results, const PoolHooks& hooks)
      : options_(options),
        results_(results),
        hooks_(hooks),
        memory_gb_(options.memory_gb > 0 ? options.memory_gb : 0.8 * available_memory_gb()) {}

  bool run(const std::vector<Cell>& cells) {
    std::deque<const Cell*> waiting;
    for (const Cell& cell : cells) {
      if (!cell.field_cell.empty()) wanted_fields_.push_back(cell.field_cell);
      if (!results_.contains(cell.id)) waiting.push_back(&cell);
    }
    bool stopping = false;
    while (!waiting.empty() || !running_.empty()) {
      if (stop_signal() != 0 && !stopping) {
        stopping = true;
        for (const Child& child : running_) kill(child.pid, SIGTERM);
      }
      if (stopping) waiting.clear();
      if (!has_room() || !start_one(waiting)) collect();
    }
    return !stopping;
  }

 private:
  // A fusion with learned depth waits for its field; when that failed, it starts and says so itself.
  bool ready(const Cell& cell, const std::deque<const Cell*>& waiting) const {
    const auto is_field = [&](const Cell* c) { return c->id == cell.field_cell; };
    return std::none_of(waiting.begin(), waiting.end(), is_field) &&
           std::none_of(running_.begin(), running_.end(), [&](const Child& c) { return is_field(c.cell); });
  }

  bool has_room() const {
    const auto together = static_cast<double>(running_.size() + 1);
    return running_.empty() || (std::ssize(running_) < options_.jobs && together * cell_gb_ <= memory_gb_);
  }

  std::vector<std::string> words_of(const Cell& cell, const fs::path& folder) const {
    const std::string config = (folder / "config.yaml").string(), run = (folder / "run").string();
    const std::string threads = "runtime.threads=" + std::to_string(options_.threads);
    std::vector<std::string> words{own_program()};
    if (!cell.fuse.method.empty()) {
      words.insert(words.end(), {"fuse", config, "--method", cell.fuse.method, "--json"});
      if (!cell.field_cell.empty())
        words.insert(words.end(),
                     {"--depth-from", (fs::path(cell_folder(options_, cell.field_cell)) / "run").string()});
    } else if (fs::exists(fs::path(run) / "checkpoints" / "latest")) {
      words.insert(words.end(), {"train", "--resume", run});
    } else {
      words.insert(words.end(), {"train", config, "--out", run});
    }
    words.insert(words.end(), {"--set", threads, "-q"});
    for (const std::string& module : options_.modules) words.insert(words.end(), {"--plugin", module});
    return words;
  }

  // Starts the first cell that may start and that nobody works on. False when there is none. Nothing of a cell is
  // touched before its lock is held.
  bool start_one(std::deque<const Cell*>& waiting) {
    for (auto next = waiting.begin(); next != waiting.end(); ++next) {
      const Cell& cell = **next;
      if (!ready(cell, waiting)) continue;
      const fs::path folder = cell_folder(options_, cell.id);
      create_folders(folder.string());
      FolderLock lock, of_run;
      int cause = lock.take(folder.string());
      if (cause == 0) cause = of_run.take((folder / "run").string(), false);
      if (cause == EWOULDBLOCK) {
        say_waiting(cell, folder, lock.held() ? of_run.holder() : lock.holder());
        continue;
      }
      if (cause != 0 && cause != ENOENT) throw write_error("lock", folder.string(), cause);
      waiting.erase(next);
      if (std::optional<CellValues> done = result_of_cell(options_, cell.id)) {
        results_[cell.id] = std::move(*done);  // since the sweep looked
        return true;
      }
      std::error_code failed;
      if (!fs::exists(folder / "run" / "checkpoints" / "latest")) fs::remove_all(folder / "run", failed);
      if (failed) throw write_error("remove", (folder / "run").string(), failed.value());
      of_run = {};
      start(cell, folder, std::move(lock));
      return true;
    }
    return false;
  }

  // Once a cell: an interrupted sweep's processes save before they end.
  void say_waiting(const Cell& cell, const fs::path& folder, const std::string& holder) {
    if (waited_for_.insert(cell.id).second)
      hooks_.note(fmt::format("{}: {} still works there; waiting for it", folder.string(), holder));
  }

  void start(const Cell& cell, const fs::path& folder, FolderLock lock) {
    const std::string config =
        cell.pack.empty() ? cell.config
                          : with_packed_scene(cell.config, options_.pack_reader, pack_file(options_, cell).string());
    write_file_atomic((folder / "config.yaml").string(), config);
    const std::vector<std::string> words = words_of(cell, folder);
    pid_t pid = 0;
    try {
      pid = start_child(words, {(folder / "output.txt").string(), (folder / "log.txt").string()},
                        [&] { lock.keep_over_exec(); });
    } catch (const Error& error) {
      if (error.kind() != ErrorKind::unavailable) throw;
      throw Error(error.kind(), "cannot start a process for a cell", "give fewer --jobs");
    }
    lock.sign(pid);
    const bool resumed = std::find(words.begin(), words.end(), "--resume") != words.end();
    running_.push_back({std::move(lock), pid, &cell, Clock::now(), resumed});
  }

  // Waits until a child ends or a moment has passed.
  void collect() {
    int status = 0;
    rusage usage{};
    const pid_t pid = wait4(-1, &status, WNOHANG, &usage);
    if (pid <= 0) {
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
      return;
    }
    const auto ended = std::find_if(running_.begin(), running_.end(), [&](const Child& c) { return c.pid == pid; });
    if (ended == running_.end()) return;
    const Child child = std::move(*ended);
    running_.erase(ended);
    cell_gb_ = std::max(ended_ == 0 ? 0 : cell_gb_, static_cast<double>(usage.ru_maxrss) / (1 << 20));
    ++ended_;
    const Cell& cell = *child.cell;
    CellOutcome outcome{&cell, false, {}, std::chrono::duration<double>(Clock::now() - child.start).count()};
    CellValues used{{"peak_mb", static_cast<double>(usage.ru_maxrss) / 1024}};
    if (!child.resumed) used.emplace_back("processor_s", seconds_of(usage.ru_utime) + seconds_of(usage.ru_stime));
    const fs::path folder = cell_folder(options_, cell.id);
    if (WIFEXITED(status) && WEXITSTATUS(status) == 0) {
      take_result(cell, folder, used, outcome);
    } else if (stop_signal() == 0) {
      outcome.failure = child_failure(status, (folder / "log.txt").string());
    } else {
      return;  // stopped with us
    }
    hooks_.finished(outcome);
  }

  static double seconds_of(const timeval& t) {
    return static_cast<double>(t.tv_sec) + 1e-6 * static_cast<double>(t.tv_usec);
  }

  // `used`: what the process took, beside what it measured.
  void take_result(const Cell& cell, const fs::path& folder, const CellValues& used, CellOutcome& outcome) {
    try {
      CellValues values = cell.fuse.method.empty()
                              ? values_of_run((folder / "run" / "metrics.jsonl").string(), cell.split)
                              : values_of_fusion(read_text_file((folder / "output.txt").string()), cell.fuse.method);
      values.insert(values.end(), used.begin(), used.end());
      write_cell_result((folder / "result.json").string(), values);
      results_[cell.id] = std::move(values);
      outcome.done = true;
      const bool wanted = std::find(wanted_fields_.begin(), wanted_fields_.end(), cell.id) != wanted_fields_.end();
      std::error_code ignored;  // a checkpoint that stays costs disk alone
      if (!options_.keep_checkpoints && !wanted) fs::remove_all(folder / "run" / "checkpoints", ignored);
    } catch (const Error& e) {
      outcome.failure = e.what();
    }
  }

  const PoolOptions& options_;
  SweepResults& results_;
  const PoolHooks& hooks_;
  double memory_gb_;
  double cell_gb_ = kFirstGuess_gb;
  int ended_ = 0;
  std::vector<Child> running_;
  std::vector<std::string> wanted_fields_;
  std::set<std::string> waited_for_;
};

}  // namespace

void pack_scenes(const std::vector<Cell>& cells, const PoolOptions& options, Registry& registry,
                 const PoolHooks& hooks) {
  for (const Cell& cell : cells) {
    const fs::path file = pack_file(options, cell);
    if (cell.pack.empty() || is_packed(file.string(), hooks)) continue;
    Diagnostics diagnostics;
    const RunConfig config = read_run_config(parse_config_text(cell.config, "cell"), registry, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    WorkSettings work = work_settings();
    work.limits = &config.limits;
    const WorkScope scope(work);
    const std::unique_ptr<Dataset> dataset = config.dataset.entry->dataset(*config.dataset.params, {config.base_dir});
    PackOptions whole;
    whole.depth_as_mm = false;  // the same bits as from the dataset
    hooks.note("packing the scene '" + cell.scene + "'");
    create_folders(file.parent_path().string());
    pack_scene(*dataset, file.string(), SceneLoadOptions{}, whole, diagnostics);
  }
}

std::string cell_folder(const PoolOptions& options, const std::string& id) {
  return (fs::path(options.folder) / "cells" / id).string();
}

bool run_cells(const std::vector<Cell>& cells, const PoolOptions& options, SweepResults& results,
               const PoolHooks& hooks) {
  install_stop_signals();
  return Pool(options, results, hooks).run(cells);
}

std::optional<CellValues> result_of_cell(const PoolOptions& options, const std::string& id) {
  return read_cell_result((fs::path(cell_folder(options, id)) / "result.json").string());
}

}  // namespace semfield::app
