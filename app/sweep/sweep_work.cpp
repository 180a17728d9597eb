#include "app/sweep/sweep_work.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstdlib>
#include <fstream>
#include <new>
#include <nlohmann/json.hpp>
#include <set>
#include <string_view>
#include <thread>
#include <utility>

#include "app/app_context.h"
#include "app/signals.h"
#include "config/config_tree.h"
#include "config/settings/run_config.h"
#include "core/error.h"
#include "core/process.h"
#include "core/text.h"
#include "eval/report/report.h"
#include "train/run_folder.h"

namespace semfield::app {

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

SweepFolder::SweepFolder(std::string path, const Sweep& sweep, const std::vector<Cell>& cells, SweepNote note,
                         bool helps)
    : path_(std::move(path)), sweep_(sweep), cells_(cells), note_(std::move(note)) {
  if (helps) return;
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

// A run as a cell of this process: its notes are its log.
class LoggedRun final : public RunListener {
 public:
  LoggedRun(const std::string& log, const std::function<int()>& stop) : log_(log), stop_(stop) {}
  void note(const std::string& text) override { log_ << text << '\n' << std::flush; }
  int stop_signal() override { return stop_(); }
  std::string write_report(const RunFolder& folder, const Session& session, const ReportFrames& frames) override {
    return write_run_report(folder, session, frames);
  }

 private:
  std::ofstream log_;
  const std::function<int()>& stop_;
};

class CellRunner {
 public:
  CellRunner(const CellOptions& options, EndedCells& ended, const CellHooks& hooks)
      : options_(options),
        ended_(ended),
        hooks_(hooks),
        memory_gb_(options.memory_gb > 0 ? options.memory_gb : 0.8 * available_memory_gb()) {}

  bool run(const std::vector<Cell>& cells) {
    for (const Cell& cell : cells) {
      if (!cell.field_cell.empty()) wanted_fields_.push_back(cell.field_cell);
      if (!ended_.has(cell.id)) waiting_.push_back(&cell);
    }
    while (!waiting_.empty()) {
      if (hooks_.stop() != 0) return false;
      const Clock::time_point look = Clock::now();
      if (run_next()) continue;
      // Looking takes a tenth of the time at most: a file system of a network has its price.
      const Clock::time_point next_look =
          Clock::now() + std::max<Clock::duration>(kCellLook, 9 * (Clock::now() - look));
      while (Clock::now() < next_look && hooks_.stop() == 0) std::this_thread::sleep_for(kLockLook);
    }
    return true;
  }

 private:
  // A fusion with learned depth waits for its field; when that failed, it starts and says so itself.
  bool ready(const Cell& cell) const {
    return std::none_of(waiting_.begin(), waiting_.end(), [&](const Cell* c) { return c->id == cell.field_cell; });
  }

  bool has_room() const {
    double cell_gb = 0;
    for (const auto& [id, values] : ended_.results)
      for (const auto& [name, value] : values)
        if (name == "peak_mb") cell_gb = std::max(cell_gb, value / 1024);
    return options_.place == 0 || (options_.place + 1) * (cell_gb > 0 ? cell_gb : kFirstGuess_gb) <= memory_gb_;
  }

  // Runs the first cell that may run and that nobody works on; forgets those that ended elsewhere. False: there is
  // none. Nothing of a cell is touched before its lock is held.
  bool run_next() {
    std::map<std::string, std::string> theirs;
    for (auto next = waiting_.begin(); next != waiting_.end();) {
      const Cell& cell = **next;
      const bool known = notice_cell(ended_, options_.folder, cell.id);
      if (!known && !(has_room() && ready(cell) && claim(cell, theirs))) {
        ++next;
        continue;
      }
      if (known || ended_.has(cell.id)) next = waiting_.erase(next);
      if (!known) return true;
    }
    for (const auto& [id, waits] : theirs) {
      if (waited_for_.insert(id).second) hooks_.waits_for(waits);
    }
    return false;
  }

  // Runs the cell, unless another process has it: then false, and who has it is added to `theirs` in words.
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
    if (!goes_on(folder)) fs::remove_all(folder / "run", failed);
    if (failed) throw write_error("remove", (folder / "run").string(), failed.value());
    of_run = {};
    run(cell, folder, lock);
    return true;
  }

  static bool goes_on(const fs::path& folder) { return fs::exists(folder / "run" / "checkpoints" / "latest"); }

  // Leaves its result or its failure, and neither after a stop signal.
  void run(const Cell& cell, const fs::path& folder, const FolderLock& lock) {
    write_file_atomic((folder / "config.yaml").string(), cell.config);
    const Clock::time_point start = Clock::now();
    CellValues used;
    std::optional<std::string> failure =
        options_.here != nullptr ? train_here(folder) : run_process(cell, folder, lock, used);
    if (!failure) return;
    CellOutcome outcome{&cell, std::move(*failure), std::chrono::duration<double>(Clock::now() - start).count()};
    if (outcome.failure.empty()) take_result(cell, folder, used, outcome);
    if (!outcome.failure.empty()) {
      write_cell_failure(options_.folder, cell.id, outcome.failure);
      ended_.failures[cell.id] = outcome.failure;
    }
    hooks_.finished(outcome);
  }

  std::vector<std::string> settings() const {
    std::vector<std::string> set{"runtime.threads=" + std::to_string(options_.threads)};
    if (!options_.device.empty()) set.push_back("runtime.device=" + options_.device);
    return set;
  }

  std::vector<std::string> words_of(const Cell& cell, const fs::path& folder) const {
    const std::string config = (folder / "config.yaml").string(), run = (folder / "run").string();
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
    } else if (goes_on(folder)) {
      words.insert(words.end(), {"train", "--resume", run});
    } else {
      words.insert(words.end(), {"train", config, "--out", run});
    }
    for (const std::string& setting : settings()) words.insert(words.end(), {"--set", setting});
    words.emplace_back("-q");
    for (const std::string& module : options_.modules) words.insert(words.end(), {"--plugin", module});
    return words;
  }

  // How it failed, "" where it did not; none after a stop signal. `used`: what the process took.
  std::optional<std::string> run_process(const Cell& cell, const fs::path& folder, const FolderLock& lock,
                                         CellValues& used) const {
    const std::string log = (folder / "log.txt").string();
    const std::vector<std::string> words = words_of(cell, folder);
    const ChildFiles files{(folder / "output.txt").string(), log};
    const ProcessEnd end = end_of_child(start_child(words, files, [&] { lock.keep_over_exec(); }), hooks_.stop);
    used = {{"peak_mb", end.peak_mb}};
    // Of a run that went on it is not all that the cell took.
    if (std::find(words.begin(), words.end(), "--resume") == words.end())
      used.emplace_back("processor_s", end.processor_s);
    if (end.status == 0) return "";
    if (hooks_.stop() != 0) return std::nullopt;
    return child_failure(end.status, log);
  }

  // The same for a training of this process.
  std::optional<std::string> train_here(const fs::path& folder) const {
    LoggedRun log((folder / "log.txt").string(), hooks_.stop);
    TrainRequest request{.out_dir = (folder / "run").string(), .resume = goes_on(folder), .driver = Driver::command};
    request.kept = &options_.here->kept;
    Registry& registry = options_.here->registry;
    try {
      const std::string config =
          request.resume ? RunFolder::read(request.out_dir).config_path() : (folder / "config.yaml").string();
      const TrainOutcome outcome = Run(load_run_config(config, settings(), registry), registry, request, &log).finish();
      return outcome.signal != 0 ? std::nullopt : std::optional<std::string>("");
    } catch (const Error& error) {
      log.note(shown(error));
      if (error.code() == "device.cuda.failed") throw;  // what fails next would say nothing of its settings
      return shown(error);
    } catch (const std::bad_alloc&) {
      log.note("out of memory");
      return "out of memory";
    }
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

  const CellOptions& options_;
  EndedCells& ended_;
  const CellHooks& hooks_;
  double memory_gb_;
  std::deque<const Cell*> waiting_;
  std::vector<std::string> wanted_fields_;
  std::set<std::string> waited_for_;
};

constexpr const char* kHelper = "SEMFIELD_HELPER";  // which one a process is

}  // namespace

bool run_cells(const std::vector<Cell>& cells, const CellOptions& options, EndedCells& ended, const CellHooks& hooks) {
  return CellRunner(options, ended, hooks).run(cells);
}

Helpers::Helpers(int count) {
  std::vector<std::string> words{own_program()};
  std::ifstream own("/proc/self/cmdline");
  std::string word;
  for (std::getline(own, word, '\0'); std::getline(own, word, '\0');) words.push_back(word);
  for (int number = 1; number <= count; ++number) {
    std::string told = fmt::format("{}={}", kHelper, number);
    std::vector<char*> environment;
    for (char** entry = environ; *entry != nullptr; ++entry) environment.push_back(*entry);
    environment.insert(environment.end(), {told.data(), nullptr});
    // What stdout gets, this process says.
    children_.emplace_back(SIGTERM).pid =
        start_child(words, ChildStreams{-1, STDERR_FILENO, STDERR_FILENO}, {}, environment);
  }
}

int Helpers::own_number() {
  const char* const told = std::getenv(kHelper);
  return told == nullptr ? 0 : to_number<int>(told).value_or(0);
}

void Helpers::stop() {
  for (const OwnedChild& child : children_)
    if (!stopped_) kill(child.pid, SIGTERM);
  stopped_ = true;
}

bool Helpers::is_about_one(const std::string& text) const {
  return std::any_of(children_.begin(), children_.end(), [&](const OwnedChild& child) {
    return text.find(fmt::format(": process {} on ", child.pid)) != std::string::npos;
  });
}

}  // namespace semfield::app
