#include "app/sweep/sweep_work.h"

#include <fmt/format.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <csignal>
#include <deque>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string_view>
#include <thread>
#include <utility>

#include "app/child_process.h"
#include "app/json_output.h"
#include "app/signals.h"
#include "config/config_tree.h"
#include "core/error.h"
#include "core/files.h"
#include "core/process.h"
#include "eval/report/report.h"
#include "eval/report/sweep.h"

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
  for (const Cell& cell : cells)
    for (const CellUse& use : cell.uses) text += cell.id + "," + use_csv(sweep, use) + "\n";
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
    for (const Cell& cell : cells_) forget_cell_failure(path_, cell.id);
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

namespace {

constexpr double kFirstGuess_gb = 1;                 // of a cell, until one has ended
constexpr std::chrono::milliseconds kCellLook{100};  // between two looks at the cells of other processes

double available_memory_gb() {
  const std::size_t bytes = available_memory();
  return bytes == kNoMemoryLimit ? 4 : static_cast<double>(bytes) / (1 << 30);
}

struct Child {
  FolderLock lock;  // of the cell's folder; shared with the process, so that it outlives a killed sweep
  pid_t pid = 0;
  const Cell* cell = nullptr;
  Clock::time_point start;
  std::string device;              // which it has alone; "": what its configuration says
  bool resumed = false;            // went on from a checkpoint: what it used is not all that the cell took
  std::unique_ptr<Server> server;  // that it runs in; null: it has a process of its own
};

class Pool {
 public:
  Pool(const PoolOptions& options, EndedCells& ended, const PoolHooks& hooks)
      : options_(options),
        ended_(ended),
        hooks_(hooks),
        memory_gb_(options.memory_gb > 0 ? options.memory_gb
                                         : 0.8 * available_memory_gb() / std::max(1, options.processes_of_host)) {}

  bool run(const std::vector<Cell>& cells) {
    for (const Cell& cell : cells) {
      if (!cell.field_cell.empty()) wanted_fields_.push_back(cell.field_cell);
      if (!ended_.has(cell.id)) waiting_.push_back(&cell);
    }
    bool stopping = false;
    while (!waiting_.empty() || !running_.empty()) {
      if (stop_signal() != 0 && !stopping) {
        stopping = true;
        for (const Child& child : running_) kill(child.pid, SIGTERM);
      }
      if (stopping) waiting_.clear();
      if (!has_room() || !start_one()) collect();
    }
    return !stopping;
  }

 private:
  // A fusion with learned depth waits for its field; when that failed, it starts and says so itself.
  bool ready(const Cell& cell) const {
    const auto is_field = [&](const Cell* c) { return c->id == cell.field_cell; };
    return std::none_of(waiting_.begin(), waiting_.end(), is_field) &&
           std::none_of(running_.begin(), running_.end(), [&](const Child& c) { return is_field(c.cell); });
  }

  bool has_room() const {
    const auto together = static_cast<double>(running_.size() + 1);
    if (!options_.devices.empty() && next_device().empty()) return false;
    return running_.empty() || (std::ssize(running_) < options_.jobs && together * cell_gb_ <= memory_gb_);
  }

  // "" where all are busy, and where the cells say themselves.
  std::string next_device() const {
    std::vector<std::string> busy;
    for (const Child& child : running_) busy.push_back(child.device);
    return free_device(options_.devices, busy);
  }

  std::vector<std::string> words_of(const Cell& cell, const fs::path& folder, const std::string& device) const {
    const std::string config = (folder / "config.yaml").string(), run = (folder / "run").string();
    const std::string threads = "runtime.threads=" + std::to_string(options_.threads);
    std::vector<std::string> words{options_.program};
    const std::string field = (fs::path(cell_folder(options_.folder, cell.field_cell)) / "run").string();
    if (cell.objects) {
      const ConfigNode root = parse_config_text(cell.config, "cell");
      words.insert(words.end(),
                   {"objects", field, "--out", (folder / "objects").string(), "--split", cell.split, "--score",
                    "--json", "--set", "objects=" + write_config_inline(*root.find("objects"))});
    } else if (!cell.fuse.method.empty()) {
      words.insert(words.end(), {"labels", "fuse", config, "--method", cell.fuse.method, "--json"});
      if (!cell.field_cell.empty()) words.insert(words.end(), {"--depth-from", field});
    } else if (fs::exists(fs::path(run) / "checkpoints" / "latest")) {
      words.insert(words.end(), {"train", "--resume", run});
    } else {
      words.insert(words.end(), {"train", config, "--out", run});
    }
    if (cell.trains() && options_.servers != nullptr) words.emplace_back("--no-3d");  // nobody looks at so many
    words.insert(words.end(), {"--set", threads, "-q"});
    if (!device.empty()) words.insert(words.end(), {"--set", "runtime.device=" + device});
    for (const std::string& module : options_.modules) words.insert(words.end(), {"--plugin", module});
    return words;
  }

  // Starts the first cell that may start and that nobody works on; forgets those that ended elsewhere. False when there
  // is none. Nothing of a cell is touched before its lock is held.
  bool start_one() {
    const Clock::time_point look = Clock::now();
    if (look < next_look_) return false;
    std::map<std::string, std::string> theirs;
    for (auto next = waiting_.begin(); next != waiting_.end();) {
      const Cell& cell = **next;
      if (notice_cell(ended_, options_.folder, cell.id)) {
        next = waiting_.erase(next);
        continue;
      }
      const bool ours = ready(cell) && claim(cell, theirs);
      if (!ours) {
        ++next;
        continue;
      }
      waiting_.erase(next);
      return true;
    }
    if (running_.empty()) {
      for (const auto& [id, waits] : theirs) {
        if (waited_for_.insert(id).second) hooks_.waits_for(waits);
      }
    }
    // Looking takes a tenth of the time at most: a file system of a network has its price.
    next_look_ = Clock::now() + std::max<Clock::duration>(kCellLook, 9 * (Clock::now() - look));
    return false;
  }

  // True when the cell needs no attempt from here any more: it was started, or it has ended meanwhile. A cell that
  // another process has is added to `theirs` in words.
  bool claim(const Cell& cell, std::map<std::string, std::string>& theirs) {
    const fs::path folder = cell_folder(options_.folder, cell.id);
    create_folders(folder.string());
    FolderLock lock, of_run;
    int cause = lock.take(folder.string());
    if (cause == 0) cause = of_run.take((folder / "run").string(), false);
    if (cause == EWOULDBLOCK) {
      const std::string& holder = lock.held() ? of_run.holder() : lock.holder();
      theirs[cell.id] = fmt::format("{}: {} still works there; waiting for it", folder.string(), holder);
      return false;
    }
    if (cause != 0 && cause != ENOENT) throw write_error("lock", folder.string(), cause);
    if (notice_cell(ended_, options_.folder, cell.id)) return true;  // since it was looked at
    std::error_code failed;
    if (!fs::exists(folder / "run" / "checkpoints" / "latest")) fs::remove_all(folder / "run", failed);
    if (failed) throw write_error("remove", (folder / "run").string(), failed.value());
    of_run = {};
    start(cell, folder, std::move(lock));
    return true;
  }

  void start(const Cell& cell, const fs::path& folder, FolderLock lock) {
    write_file_atomic((folder / "config.yaml").string(), cell.config);
    const std::string device = next_device();
    const std::vector<std::string> words = words_of(cell, folder, device);
    const ChildFiles files{(folder / "output.txt").string(), (folder / "log.txt").string()};
    std::unique_ptr<Server> server;
    pid_t pid = 0;
    try {
      if (options_.servers != nullptr) {
        server = idle_server(device);
        server->begin(words, files);
        pid = server->pid();
      } else {
        pid = start_child(words, files, [&] { lock.keep_over_exec(); });
      }
    } catch (const Error& error) {
      if (error.kind() != ErrorKind::unavailable) throw;
      throw Error(error.kind(), error.code(), "cannot start a process for a cell", "give fewer --jobs");
    }
    lock.sign(pid);
    const bool resumed = std::find(words.begin(), words.end(), "--resume") != words.end();
    running_.push_back({std::move(lock), pid, &cell, Clock::now(), device, resumed, std::move(server)});
  }

  std::unique_ptr<Server> idle_server(const std::string& device) const {
    auto idle = options_.servers->extract(device);
    return idle ? std::move(idle.mapped()) : std::make_unique<Server>(options_.program);
  }

  // Waits until a child ends or a moment has passed.
  void collect() {
    for (auto child = running_.begin(); child != running_.end(); ++child) {
      const std::optional<ProcessEnd> end = child->server ? child->server->end() : std::nullopt;
      if (end) return collect(child, *end);
    }
    int status = 0;
    rusage usage{};
    const pid_t pid = wait4(-1, &status, WNOHANG, &usage);
    if (pid <= 0) {
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
      return;
    }
    if (options_.servers != nullptr)
      std::erase_if(*options_.servers, [&](const auto& idle) {
        if (idle.second->pid() == pid) idle.second->is_gone();
        return idle.second->pid() < 0;
      });
    const auto ended = std::find_if(running_.begin(), running_.end(), [&](const Child& c) { return c.pid == pid; });
    if (ended == running_.end()) return;
    if (ended->server) std::exchange(ended->server, nullptr)->is_gone();
    collect(ended, process_end(status, usage));
  }

  void collect(std::vector<Child>::iterator ended, const ProcessEnd& end) {
    Child child = std::move(*ended);  // its lock is held until all that it leaves is written
    running_.erase(ended);
    next_look_ = {};
    // One whose cell failed may have lost its device, and ends.
    if (child.server && end.status == 0) options_.servers->emplace(child.device, std::move(child.server));
    cell_gb_ = std::max(measured_ == 0 ? 0 : cell_gb_, end.peak_mb / 1024);
    ++measured_;
    const Cell& cell = *child.cell;
    CellOutcome outcome{&cell, {}, std::chrono::duration<double>(Clock::now() - child.start).count()};
    CellValues used{{"peak_mb", end.peak_mb}};
    if (!child.resumed) used.emplace_back("processor_s", end.processor_s);
    const fs::path folder = cell_folder(options_.folder, cell.id);
    if (WIFEXITED(end.status) && WEXITSTATUS(end.status) == 0) {
      take_result(cell, folder, used, outcome);
    } else if (stop_signal() == 0) {
      outcome.failure = child_failure(end.status, (folder / "log.txt").string());
    } else {
      return;  // stopped with us
    }
    if (!outcome.failure.empty()) {
      write_cell_failure(options_.folder, cell.id, outcome.failure);
      ended_.failures[cell.id] = outcome.failure;
    }
    hooks_.finished(outcome);
  }

  static CellValues values_of(const Cell& cell, const fs::path& folder) {
    if (cell.trains()) return values_of_run((folder / "run" / "metrics.jsonl").string(), cell.split);
    const std::string told = read_text_file((folder / "output.txt").string());
    return cell.objects ? values_of_objects(told) : values_of_fusion(told, cell.fuse.method);
  }

  // `used`: what the process took, beside what it measured.
  void take_result(const Cell& cell, const fs::path& folder, const CellValues& used, CellOutcome& outcome) {
    try {
      CellValues values = values_of(cell, folder);
      values.insert(values.end(), used.begin(), used.end());
      write_cell_result((folder / "result.json").string(), values);
      (void)notice_cell(ended_, options_.folder, cell.id);
      const bool wanted = std::find(wanted_fields_.begin(), wanted_fields_.end(), cell.id) != wanted_fields_.end();
      std::error_code ignored;  // a checkpoint that stays costs disk alone
      if (!options_.keep_checkpoints && !wanted) fs::remove_all(folder / "run" / "checkpoints", ignored);
    } catch (const Error& e) {
      outcome.failure = shown(e);
    }
  }

  const PoolOptions& options_;
  EndedCells& ended_;
  const PoolHooks& hooks_;
  double memory_gb_;
  double cell_gb_ = kFirstGuess_gb;
  int measured_ = 0;
  std::deque<const Cell*> waiting_;
  std::vector<Child> running_;
  Clock::time_point next_look_;
  std::vector<std::string> wanted_fields_;
  std::set<std::string> waited_for_;
};

}  // namespace

bool run_cells(const std::vector<Cell>& cells, const PoolOptions& options, EndedCells& ended, const PoolHooks& hooks) {
  install_stop_signals();
  return Pool(options, ended, hooks).run(cells);
}

}  // namespace semfield::app
