// sweep, demo: verbs that start the program again for each of their parts.
#include "eval/report/sweep.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "app/child_process.h"
#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/signals.h"
#include "app/sweep/sweep_work.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "compute/parallel.h"
#include "config/config_tree.h"
#include "config/config_words.h"
#include "config/settings/run_config.h"
#include "core/error.h"
#include "core/files.h"
#include "core/process.h"
#include "core/text.h"
#include "core/view.h"
#include "execution/device_library.h"
#include "execution/ranks/ranks.h"
#include "train/run_folder.h"

namespace semfield::app {

// sweep: experiments as grids of differences, cell by cell, with tables and plots.

namespace {

struct SweepOptions : Options {
  explicit SweepOptions(const Declaration& at) : Options(at) { excludes("--devices", "--jobs"); }
  const std::string& file = operand("file", "sweep file (YAML)");
  const std::string& out =
      value("--out FOLDER", "folder of cells and tables (default: runs/<name>); an existing one is resumed");
  const std::optional<int>& jobs = value_in<std::optional<int>>(
      "--jobs N", {}, 1, 4096, "cells at a time of this process (default: its share of the host's cores)");
  const std::optional<int>& threads =
      value_in<std::optional<int>>("--threads N", {}, 1, 4096, "threads of each cell (default: 1)");
  const std::optional<double>& memory_gb = positive(
      "--memory GB", "GB that the cells of this process together may use (default: its share of 80 % of what is free)");
  const std::vector<std::string>& devices =
      list("--devices LIST", "CUDA devices that cells run on, one cell at a time on each: all, or numbers (0,1)");
  const bool& keep_checkpoints = flag("--keep-checkpoints", "keep the checkpoints of finished cells");
  const bool& dry_run = flag("--dry-run", "list the cells, then stop");
};

std::string minutes_text(double seconds) {
  return seconds < 90 ? fmt::format("{:.0f} s", seconds) : fmt::format("{:.0f} min", seconds / 60);
}

// Where this process stands among those that work on the sweep.
struct Place {
  std::optional<Launched> launched;  // none: started by hand
  int of_host() const { return launched ? launched->local_size : 1; }
  int of_all() const { return launched ? launched->size : 1; }
  // Of several that a launcher started, one prints what is said once.
  bool reports() const { return !launched || launched->rank == 0; }
  std::string prefix() const { return launched ? fmt::format("rank {}: ", launched->rank) : ""; }
};

// Every device that --devices names, or that this machine has.
std::vector<std::string> named_devices(const std::vector<std::string>& words) {
  const std::string remedy = "leave --devices out: each cell then runs on the device that its configuration says";
  std::string why_not;
  if (words == std::vector<std::string>{"all"}) {
    std::vector<std::string> devices;
    for (int n = 0; cuda_available(&why_not, n); ++n) devices.push_back(fmt::format("cuda:{}", n));
    if (devices.empty())
      throw Error(ErrorKind::unavailable, "device.gpu.unavailable", "--devices all: " + why_not, remedy);
    return devices;
  }
  std::vector<std::string> devices = device_names(words);
  for (const std::string& device : devices) {
    if (!cuda_available(&why_not, device_of(device)->ordinal))
      throw Error(ErrorKind::unavailable, "device.gpu.unavailable",
                  fmt::format("--devices: no {}: {}", device, why_not), remedy);
  }
  return devices;
}

// Those of this process; none where --devices is not given.
std::vector<std::string> own_devices(const SweepOptions& options, const Place& place) {
  if (options.devices.empty()) return {};
  const std::vector<std::string> devices = named_devices(options.devices);
  if (!place.launched) return devices;
  const Launched& by = *place.launched;
  if (std::ssize(devices) < by.local_size)
    throw Error(ErrorKind::usage, "ranks.devices.too_few",
                fmt::format("{} started {} processes on this host, and --devices gives them {}: {}", by.by,
                            by.local_size, devices.size(), join(devices)),
                "start no more processes on a host than it has devices, each of which sees all of them (srun "
                "--gpu-bind=none)");
  return devices_of_process(devices, by.local_rank, by.local_size);
}

// As far as control groups grant them, wherever a launcher bound this process.
int cores_of_host() {
  const auto all = static_cast<int>(sysconf(_SC_NPROCESSORS_ONLN));
  const int quota = cpu_quota();
  return quota > 0 ? std::min(quota, all) : all;
}

PoolOptions pool_options(const SweepOptions& options, const Sweep& sweep, const Place& place,
                         const Registry& registry) {
  PoolOptions pool;
  pool.folder = options.out.empty() ? "runs/" + sweep.name : options.out;
  pool.program = own_program();
  pool.threads = std::max(1, options.threads.value_or(1));
  pool.jobs = options.jobs.value_or(cells_at_a_time(thread_count(), cores_of_host(), place.of_host(), pool.threads));
  pool.memory_gb = options.memory_gb.value_or(0);
  pool.processes_of_host = place.of_host();
  pool.keep_checkpoints = options.keep_checkpoints;
  pool.modules = registry.module_files();
  return pool;
}

// Lists the cells and which of them are done.
int list_cells(const std::vector<Cell>& cells, const std::string& folder, const Sweep& sweep,
               const AppContext& context) {
  int done = 0;
  Json planned = Json::array();
  std::string lines;
  for (const Cell& cell : cells) {
    const bool is_done = result_of_cell(folder, cell.id).has_value();
    done += is_done ? 1 : 0;
    planned.push_back(
        {{"cell", cell.id}, {"label", cell.label}, {"scene", cell.scene}, {"seed", cell.seed}, {"done", is_done}});
    lines +=
        fmt::format("{} {}, {}, seed {}{}\n", cell.id, cell.label, cell.scene, cell.seed, is_done ? " (done)" : "");
  }
  print_note(context, fmt::format("{}: {} experiments, {} cells, {} of them done, in {}", sweep.name,
                                  sweep.experiments.size(), cells.size(), done, folder));
  print_results(context, {{"folder", folder}, {"planned", planned}}, lines);
  return 0;
}

// What the user sees while cells run, and in the end.
class SweepProgress {
 public:
  SweepProgress(const Sweep& sweep, const std::vector<Cell>& cells, const Place& place, AppContext& context)
      : sweep_(sweep), cells_(cells), place_(place), context_(context) {}

  void begin(const PoolOptions& pool, const SweepFolder& folder, const EndedCells& ended) {
    at_a_time_ = pool.jobs * place_.of_all();
    if (!place_.reports()) return;
    const std::string processes = place_.launched ? fmt::format(" in each of {} processes", place_.of_all()) : "";
    const std::string devices = pool.devices.empty() ? "" : " on " + join(pool.devices);
    print_note(
        context_,
        fmt::format("{}: {} experiments, {} cells, {} of them done; {} at a time{} with {} threads each{}, in {}",
                    sweep_.name, sweep_.experiments.size(), cells_.size(), ended.results.size(), pool.jobs, processes,
                    pool.threads, devices, pool.folder));
    if (!folder.beside().empty() && !place_.launched)
      print_note(context_, folder.beside() + " works on this sweep too; they share the cells");
    const int own = hardware_threads(), cores = cores_of_host();
    if (place_.launched && pool.devices.empty() && own < cores / place_.of_host())
      print_note(context_, fmt::format("{} lets this process use {} of {} cores (mpirun --bind-to none: all)",
                                       place_.launched->by, own, cores));
  }

  void note(const std::string& text) const { print_note(context_, place_.prefix() + text); }

  void finished(const CellOutcome& outcome, const EndedCells& ended) {
    ++ran_;
    seconds_ += outcome.seconds;
    const Cell& cell = *outcome.cell;
    const std::size_t left = cells_.size() - ended.results.size() - ended.failures.size();
    const double left_s = seconds_ / static_cast<double>(ran_) * static_cast<double>(left) / at_a_time_;
    std::string what = outcome.failure;
    if (what.empty()) {
      const std::string& metric = sweep_.experiments[cell.uses.front().experiment].metrics.front();
      for (const auto& [name, value] : ended.results.at(cell.id)) {
        if (name == metric) what = fmt::format("{} {:.3f}", metric, value);
      }
    }
    note(fmt::format("[{}/{}] {}, {}, seed {}: {} ({:.0f} s, {} left)", ended.results.size(), cells_.size(), cell.label,
                     cell.scene, cell.seed, what, outcome.seconds, minutes_text(left_s)));
  }

  // The exit code. A rank that does not report ends with 0 although cells failed: a launcher takes another code for a
  // broken process, and ends the others.
  int end(bool whole, const std::string& folder, const EndedCells& ended) const {
    const std::size_t done = ended.results.size(), failed = ended.failures.size();
    if (place_.reports())
      print_results(context_, {{"folder", folder}, {"cells", cells_.size()}, {"done", done}, {"failed", failed}},
                    fmt::format("sweep: cells={} done={} failed={} folder={}", cells_.size(), done, failed, folder));
    if (!whole) {
      if (place_.reports()) print_note(context_, "stopped; the same command resumes the sweep");
      return 128 + stop_signal();
    }
    return failed > 0 && place_.reports() ? static_cast<int>(ErrorKind::failure) : 0;
  }

 private:
  const Sweep& sweep_;
  const std::vector<Cell>& cells_;
  const Place& place_;
  AppContext& context_;
  int at_a_time_ = 1;
  std::size_t ran_ = 0;
  double seconds_ = 0;
};

// This process's part of the work. Throws what went wrong here, which need not go wrong in the other processes.
int work(const SweepOptions& options, const Sweep& sweep, const std::vector<Cell>& cells, const Place& place,
         AppContext& context) {
  PoolOptions pool = pool_options(options, sweep, place, context.registry);
  if (options.dry_run) return place.reports() ? list_cells(cells, pool.folder, sweep, context) : 0;
  pool.devices = own_devices(options, place);
  if (!pool.devices.empty()) pool.jobs = static_cast<int>(pool.devices.size());

  SweepProgress progress(sweep, cells, place, context);
  const SweepNote note = [&](const std::string& text) { progress.note(text); };
  const SweepFolder folder(pool.folder, sweep, cells, note);
  EndedCells ended;
  for (const Cell& cell : cells) notice_cell(ended, pool.folder, cell.id);
  progress.begin(pool, folder, ended);
  PoolHooks hooks;
  hooks.finished = [&](const CellOutcome& outcome) {
    folder.write_tables(ended);
    progress.finished(outcome, ended);
  };
  hooks.waits_for = [&](const std::string& text) {
    if (place.reports()) progress.note(text);
  };
  const bool whole = run_cells(cells, pool, ended, hooks);
  folder.write_tables(ended);
  return progress.end(whole, pool.folder, ended);
}

int run(const SweepOptions& options, AppContext& context) {
  const Place place{launched()};
  bool planned = false;
  try {
    const Sweep sweep = read_sweep(options.file);
    const std::vector<Cell> cells = plan_cells(sweep, context.registry);
    planned = true;
    return work(options, sweep, cells, place, context);
  } catch (const Error& error) {
    if (place.reports()) throw;
    // What is wrong with the file rank 0 reports for all; it gets the time, because launchers end all when one fails.
    if (planned) {
      say("semfield: " + place.prefix() + shown(error), context.terminal);
    } else {
      sleep(1);
    }
    throw;
  }
}

}  // namespace

Verb verb_sweep() {
  return make_verb<SweepOptions>("sweep", 50, "run experiments: a grid of differences, scenes and seeds", run,
                                 Launch::beside);
}

// demo: the verbs that make a labelled scene, one after the other, on the shipped room.

namespace {

constexpr const char* kOwnFolder = "runs/demo";

struct DemoOptions : Options {
  explicit DemoOptions(const Declaration& at) : Options(at) { threads(set); }
  const std::string& out =
      value("--out FOLDER", "run folder to create (default: runs/demo, whose earlier demo is replaced)");
  std::vector<std::string>& set = settings();
  const LengthWords length = training_length();
};

// How a person starts this program: by its name where PATH leads to it.
std::string typed_program() {
  const fs::path own = own_program();
  std::error_code unknown;
  if (const std::string found = program_in_path(own.filename().string());
      !found.empty() && fs::equivalent(found, own, unknown))
    return own.filename();
  const fs::path near = own.lexically_relative(fs::current_path());
  return shell_word(near.empty() || *near.begin() == ".." ? own.string() : near.string());
}

bool is_demo(const std::string& folder) {
  const std::string file = (fs::path(folder) / "run.yaml").string();
  std::error_code unknown;
  if (!is_there(file)) return false;
  const ConfigNode tree = parse_config_file(file);
  const ConfigNode* name = tree.find("name");
  const ConfigNode* scene = tree.find("scene");
  const ConfigNode* root = scene != nullptr ? scene->find("root") : nullptr;
  return name != nullptr && name->text() == "demo" && root != nullptr &&
         fs::equivalent(root->text(), shared_file("scenes/room"), unknown);
}

// Of the folder that nobody has named, only what an earlier demo wrote is replaced.
void clear_own_folder(const AppContext& context) {
  std::error_code unknown;
  const fs::directory_iterator entries(kOwnFolder, unknown);
  // A demo that was stopped before its first step leaves the lock alone.
  if (unknown ||
      std::all_of(begin(entries), end(entries), [](const auto& e) { return e.path().filename() == ".lock"; }))
    return;
  if (!is_demo(kOwnFolder))
    throw Error(ErrorKind::cannot_create, "files.output.exists",
                fmt::format("'{}' is there already and is not an earlier demo", kOwnFolder),
                "name a new folder with --out");
  print_note(context, fmt::format("the earlier demo in {} is replaced", kOwnFolder));
  const RunFolder held = RunFolder::resume(kOwnFolder);  // refuses one that is being trained
  fs::remove_all(kOwnFolder);
}

// The figures of train's last line that say what came out.
std::string figures_of(const std::string& out) {
  std::istringstream words(out.substr(out.rfind("train: ") == std::string::npos ? 0 : out.rfind("train: ") + 7));
  std::vector<std::string> kept;
  for (std::string word; words >> word;) {
    if (!word.starts_with("steps=") && !word.starts_with("trained_s=") && !word.starts_with("peak_mb="))
      kept.push_back(word);
  }
  return join(kept, " ");
}

int run(const DemoOptions& options, AppContext& context) {
  const std::string config = shared_file("configs/quickstart.yaml");  // a file `quickstart.yaml` here is not meant
  const std::string out = options.out.empty() ? kOwnFolder : options.out;
  (void)asked_length(options.length);
  load_run_config(config, options.set, context.registry);  // refuses what is wrong before anything is replaced
  const std::string cache = cache_folder("rooms");
  print_note(context, fmt::format("a demo on the shipped room, in {}{}", fs::absolute(out).lexically_normal().string(),
                                  cache.empty() ? "" : "; cast frames are kept in " + cache));
  if (options.out.empty()) clear_own_folder(context);
  (void)RunFolder::create(out);  // refuses a folder that cannot be written before the scene is read
  // The figures are of every test frame, on a slow machine too.
  const std::string named = find_config("quickstart") == config ? "quickstart" : config;
  std::vector<std::string> train{"train", named, "--set", "report.eval_share=0", "--set", "name=demo", "--out", out};
  for (const std::string& setting : options.set) {
    // "--threads runtime.threads=2" was typed as "--threads 2".
    train.push_back("--set");
    train.push_back(setting.starts_with("--") ? setting.substr(setting.find(' ') + 1) : setting);
  }
  if (options.length.steps) train.insert(train.end(), {"--steps", std::to_string(*options.length.steps)});
  if (!options.length.time.empty()) train.insert(train.end(), {"--time", options.length.time});
  const std::string program = typed_program();
  install_stop_signals(!context.quiet);
  leave_next_out_of_children();
  std::string figures;
  for (std::vector<std::string> words :
       {train, {"render", out, "--split", "test"}, {"mesh", out, "--format", "ply,glb"}}) {
    std::string shown = program;
    for (const std::string& word : words) shown += " " + shell_word(word);
    print_note(context, "$ " + shown);
    words.insert(words.begin(), own_program());
    if (context.quiet) words.push_back("--quiet");
    if (context.json) words.push_back("--json");
    const ChildEnd end = run_child(words);
    if (!context.quiet) std::fputs(end.out.c_str(), stderr);
    if (end.code != 0) return end.code;
    if (figures.empty()) figures = context.json ? end.out : figures_of(end.out);
  }
  const std::string folder = shell_word(out);
  print_note(
      context,
      fmt::format(
          "\nThe room is labelled: {0}\n"
          "  report            {0}/report.html\n"
          "  labels, depth, …  {0}/render/test/\n"
          "  labelled mesh     {0}/mesh.ply, {0}/mesh.glb; by class: {0}/mesh_classes.ply, {0}/mesh_classes.glb\n"
          "  all figures       {1} eval {0}\n"
          "  longer training   {1} train --resume {0} --time 5m\n"
          "Your own scene: write my_scene.yaml, with `include: presets/room.yaml` and where the "
          "scene is, then\n  {1} inspect my_scene.yaml\n"
          "The guide docs/guide/own_data.md says how.",
          folder, program));
  if (context.json) {
    Json found = Json::parse(figures);  // by `train`
    found.erase("semfield");
    found.erase("verb");
    print_json(context, found);
    return 0;
  }
  std::printf("demo: %s\n", figures.c_str());
  return 0;
}

}  // namespace

Verb verb_demo() {
  return make_verb<DemoOptions>("demo", 5, "train on the shipped room, render its held-out views and write its mesh",
                                run);
}

}  // namespace semfield::app
