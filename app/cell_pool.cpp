#include "cell_pool.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <deque>
#include <filesystem>
#include <thread>

#include "core/files.h"
#include "core/memory_limit.h"
#include "signals.h"
#include "train/run_config.h"
#include "verb_pack.h"

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

struct Child {
  pid_t pid = 0;
  const Cell* cell = nullptr;
  Clock::time_point start;
  bool resumed = false;  // went on from a checkpoint: what it used is not all that the cell took
};

class Pool {
 public:
  Pool(const PoolOptions& options, SweepResults& results, const std::function<void(const CellOutcome&)>& finished)
      : options_(options),
        results_(results),
        finished_(finished),
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
      const auto next = std::find_if(waiting.begin(), waiting.end(), [&](const Cell* c) { return ready(*c, waiting); });
      if (next != waiting.end() && has_room()) {
        start(**next);
        waiting.erase(next);
        continue;
      }
      collect();
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
    const std::string program = fs::read_symlink("/proc/self/exe").string();
    const std::string config = (folder / "config.yaml").string(), run = (folder / "run").string();
    const std::string threads = "runtime.threads=" + std::to_string(options_.threads);
    if (!cell.fuse.method.empty()) {
      std::vector<std::string> words{program, "fuse",  config,   "--method", cell.fuse.method,
                                     "--set", threads, "--json", "-q"};
      if (!cell.field_cell.empty()) {
        words.insert(words.end(),
                     {"--depth-from", (fs::path(cell_folder(options_, cell.field_cell)) / "run").string()});
      }
      return words;
    }
    if (fs::exists(fs::path(run) / "checkpoints" / "latest"))
      return {program, "train", "--resume", run, "--set", threads, "-q"};
    fs::remove_all(run);
    return {program, "train", config, "--out", run, "--set", threads, "-q"};
  }

  void start(const Cell& cell) {
    const fs::path folder = cell_folder(options_, cell.id);
    std::error_code failed;
    fs::create_directories(folder, failed);
    if (failed)
      throw Error(ErrorKind::cannot_create, folder.string() + ": cannot create the folder: " + failed.message(),
                  "choose another --out");
    const std::string config =
        cell.pack.empty() ? cell.config : with_packed_scene(cell.config, pack_file(options_, cell).string());
    write_file_atomic((folder / "config.yaml").string(), config);
    const std::vector<std::string> words = words_of(cell, folder);
    const std::string out = (folder / "output.txt").string(), log = (folder / "log.txt").string();
    std::vector<char*> argv;
    for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
    argv.push_back(nullptr);
    const pid_t pid = fork();
    if (pid == 0) {
      prctl(PR_SET_PDEATHSIG, SIGTERM);  // a killed sweep leaves no cell behind
      dup2(open(out.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644), STDOUT_FILENO);
      dup2(open(log.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644), STDERR_FILENO);
      execv(argv[0], argv.data());
      _exit(127);
    }
    if (pid < 0) throw Error(ErrorKind::unavailable, "cannot start a process for a cell", "give fewer --jobs");
    const bool resumed = std::find(words.begin(), words.end(), "--resume") != words.end();
    running_.push_back({pid, &cell, Clock::now(), resumed});
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
    const auto child = std::find_if(running_.begin(), running_.end(), [&](const Child& c) { return c.pid == pid; });
    if (child == running_.end()) return;
    cell_gb_ = std::max(ended_ == 0 ? 0 : cell_gb_, static_cast<double>(usage.ru_maxrss) / (1 << 20));
    ++ended_;
    const Cell& cell = *child->cell;
    CellOutcome outcome{&cell, false, {}, std::chrono::duration<double>(Clock::now() - child->start).count()};
    CellValues used{{"peak_mb", static_cast<double>(usage.ru_maxrss) / 1024}};
    if (!child->resumed) used.emplace_back("processor_s", seconds_of(usage.ru_utime) + seconds_of(usage.ru_stime));
    running_.erase(child);
    const fs::path folder = cell_folder(options_, cell.id);
    if (WIFEXITED(status) && WEXITSTATUS(status) == 0) {
      take_result(cell, folder, used, outcome);
    } else if (stop_signal() == 0) {
      outcome.failure = failure_text(status, folder);
    } else {
      return;  // stopped with us
    }
    finished_(outcome);
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

  static std::string failure_text(int status, const fs::path& folder) {
    const std::string log = read_text_file((folder / "log.txt").string());
    const std::size_t end = log.find_last_not_of("\n");
    const std::size_t begin = end == std::string::npos ? 0 : log.find_last_of('\n', end);
    const std::string last =
        end == std::string::npos ? "" : log.substr(begin == std::string::npos ? 0 : begin + 1, end - begin);
    const std::string how = WIFSIGNALED(status) ? fmt::format("ended by signal {}", WTERMSIG(status))
                                                : fmt::format("exit code {}", WEXITSTATUS(status));
    return fmt::format("{}: {} (see {})", how, last, (folder / "log.txt").string());
  }

  const PoolOptions& options_;
  SweepResults& results_;
  const std::function<void(const CellOutcome&)>& finished_;
  double memory_gb_;
  double cell_gb_ = kFirstGuess_gb;
  int ended_ = 0;
  std::vector<Child> running_;
  std::vector<std::string> wanted_fields_;
};

}  // namespace

void pack_scenes(const std::vector<Cell>& cells, const PoolOptions& options, Registry& registry,
                 const std::function<void(const std::string&)>& note) {
  for (const Cell& cell : cells) {
    const fs::path file = pack_file(options, cell);
    if (cell.pack.empty() || fs::exists(file)) continue;
    Diagnostics diagnostics;
    const RunConfig config = read_run_config(parse_config_text(cell.config, "cell"), registry, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    set_input_limits(config.limits);
    const std::unique_ptr<Dataset> dataset = config.dataset.entry->dataset(*config.dataset.params, {config.base_dir});
    PackOptions whole;
    whole.depth_as_mm = false;  // the same bits as from the dataset
    note("packing the scene '" + cell.scene + "'");
    fs::create_directories(file.parent_path());
    pack_scene(*dataset, file.string(), SceneLoadOptions{}, whole, diagnostics);
  }
}

std::string cell_folder(const PoolOptions& options, const std::string& id) {
  return (fs::path(options.folder) / "cells" / id).string();
}

bool run_cells(const std::vector<Cell>& cells, const PoolOptions& options, SweepResults& results,
               const std::function<void(const CellOutcome&)>& finished) {
  install_stop_signals();
  return Pool(options, results, finished).run(cells);
}

}  // namespace semfield::app
