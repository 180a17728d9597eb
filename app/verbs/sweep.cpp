// sweep, tune, demo: verbs that start the program again for each of their parts.
#include "eval/report/sweep.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <regex>
#include <set>

#include "app/child_process.h"
#include "app/scene/inspect_report.h"
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
#include "core/text.h"
#include "core/view.h"
#include "eval/report/report.h"
#include "eval/report/tune.h"
#include "execution/device_library.h"
#include "formats/image_io.h"
#include "train/run_folder.h"

namespace semfield::app {

// sweep: experiments as grids of differences, cell by cell, with tables and plots.

namespace {

struct SweepOptions : Options {
  explicit SweepOptions(const Declaration& at) : Options(at) { excludes("--devices", "--jobs"); }
  const std::string& file = operand("file", "sweep file (YAML)");
  const std::string& out =
      value("--out FOLDER", "folder of cells and tables (default: runs/<name>); an existing one is resumed");
  const std::optional<int>& jobs =
      value_in<std::optional<int>>("--jobs N", {}, 1, 4096, "cells at a time (default: one for each core)");
  const std::optional<int>& threads =
      value_in<std::optional<int>>("--threads N", {}, 1, 4096, "threads of each cell (default: 1)");
  const std::optional<double>& memory_gb =
      positive("--memory GB", "GB that the cells together may use (default: 80 % of what is free)");
  const std::vector<std::string>& devices =
      list("--devices LIST", "CUDA devices that cells run on, one cell at a time on each: all, or numbers (0,1)");
  const bool& keep_checkpoints = flag("--keep-checkpoints", "keep the checkpoints of finished cells");
  const bool& dry_run = flag("--dry-run", "list the cells, then stop");
};

std::string minutes_text(double seconds) {
  return seconds < 90 ? fmt::format("{:.0f} s", seconds) : fmt::format("{:.0f} min", seconds / 60);
}

// Every device that --devices names, or that this machine has; none where it is not given.
std::vector<std::string> named_devices(const std::vector<std::string>& words) {
  if (words.empty()) return {};
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

// Cells at a time of this process and its helpers, and what each of them has.
struct Share {
  std::vector<std::string> devices;
  int jobs = 1, threads = 1;
};

CellOptions cell_options(const Share& share, const std::string& folder, const Registry& registry) {
  CellOptions own;
  own.folder = folder;
  own.program = own_program();
  own.threads = share.threads;
  own.place = Helpers::own_number();
  own.modules = registry.module_files();
  if (!share.devices.empty()) own.device = share.devices.at(static_cast<std::size_t>(own.place));
  return own;
}

CellHooks hooks_of(Helpers& helpers, const AppContext& context) {
  CellHooks hooks;
  hooks.waits_for = [&](const std::string& text) {
    if (Helpers::own_number() == 0 && !helpers.is_about_one(text)) print_note(context, text);
  };
  hooks.stop = [&helpers] {
    if (stop_signal() != 0) helpers.stop();
    return stop_signal();
  };
  return hooks;
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

// "[3/12] experiment / variant, scene, seed 1: psnr 30.125".
std::string ended_text(const CellOutcome& outcome, const Sweep& sweep, std::size_t cells, const EndedCells& ended) {
  const Cell& cell = *outcome.cell;
  std::string what = outcome.failure;
  if (what.empty()) {
    const std::string& metric = sweep.experiments[cell.uses.front().experiment].metrics.front();
    for (const auto& [name, value] : ended.results.at(cell.id))
      if (name == metric) what = fmt::format("{} {:.3f}", metric, value);
  }
  return fmt::format("[{}/{}] {}, {}, seed {}: {}", ended.results.size(), cells, cell.label, cell.scene, cell.seed,
                     what);
}

int run(const SweepOptions& options, AppContext& context) {
  const Sweep sweep = read_sweep(options.file);
  const std::vector<Cell> cells = plan_cells(sweep, context.registry);
  const std::string path = options.out.empty() ? "runs/" + sweep.name : options.out;
  if (options.dry_run) return list_cells(cells, path, sweep, context);
  Share share{named_devices(options.devices)};
  share.threads = std::max(1, options.threads.value_or(1));
  share.jobs = !share.devices.empty() ? static_cast<int>(share.devices.size())
                                      : options.jobs.value_or(std::max(1, thread_count() / share.threads));
  CellOptions own = cell_options(share, path, context.registry);
  own.memory_gb = options.memory_gb.value_or(0);
  own.keep_checkpoints = options.keep_checkpoints;
  const bool helps = own.place > 0;

  install_stop_signals();
  const SweepNote note = [&](const std::string& text) { print_note(context, text); };
  const SweepFolder folder(path, sweep, cells, note, helps);
  EndedCells ended;
  for (const Cell& cell : cells) notice_cell(ended, path, cell.id);
  const auto left = [&] { return static_cast<int>(cells.size() - ended.results.size() - ended.failures.size()); };
  if (!helps)
    note(fmt::format("{}: {} experiments, {} cells, {} of them done; {} at a time with {} threads each{}, in {}",
                     sweep.name, sweep.experiments.size(), cells.size(), ended.results.size(), share.jobs,
                     share.threads, share.devices.empty() ? "" : " on " + join(share.devices), path));
  if (!folder.beside().empty()) note(folder.beside() + " works on this sweep too; they share the cells");
  Helpers helpers(helps ? 0 : std::min(share.jobs, left()) - 1);
  CellHooks hooks = hooks_of(helpers, context);
  int ran = 0;
  double seconds = 0;
  hooks.finished = [&](const CellOutcome& outcome) {
    folder.write_tables(ended);
    seconds += outcome.seconds;
    note(fmt::format("{} ({:.0f} s, {} left)", ended_text(outcome, sweep, cells.size(), ended), outcome.seconds,
                     minutes_text(seconds / ++ran * left() / share.jobs)));
  };
  const bool whole = run_cells(cells, own, ended, hooks);
  folder.write_tables(ended);
  const std::size_t done = ended.results.size(), failed = ended.failures.size();
  const int code = !whole ? 128 + stop_signal() : failed > 0 ? static_cast<int>(ErrorKind::failure) : 0;
  if (helps) return code;
  print_results(context, {{"folder", path}, {"cells", cells.size()}, {"done", done}, {"failed", failed}},
                fmt::format("sweep: cells={} done={} failed={} folder={}", cells.size(), done, failed, path));
  if (!whole) note("stopped; the same command resumes the sweep");
  return code;
}

}  // namespace

Verb verb_sweep() {
  return make_verb<SweepOptions>("sweep", 50, "run experiments: a grid of differences, scenes and seeds",
                                 {"my_sweep.yaml --dry-run", "my_sweep.yaml --jobs 2"}, run, Launch::beside);
}

// tune: a race of settings over a scene's own held-out views.

namespace {

struct TuneOptions : Options {
  explicit TuneOptions(const Declaration& at) : Options(at) {
    excludes("--steps", "--length");
    excludes("--devices", "--jobs");
  }
  const std::string& config = operand("config", "configuration file (YAML)");
  const std::string& time = value("--time TIME", "time for the whole race, such as 90s, 2m or 1h", "2m");
  const std::string& length = value(
      "--length TIME", "training to tune for (default: train.time_s or train.steps, or else an eighth of --time)");
  const std::optional<long long>& steps = value_in<std::optional<long long>>(
      "--steps N", {}, 16, 1e9, "the same in steps: then a race can be repeated exactly");
  const std::string& aim = choice("--for SCORE", "psnr", tune_aims(), "what is tuned for");
  const std::string& space =
      value("--space FILE",
            "axes and their values (YAML; default: configs/tune/ has one for the preset of the configuration)");
  const int& seeds = value_in<int>("--seeds N", 2, 1, 64, "seeds of a candidate");
  const std::string& out = value("--out FOLDER", "folder of cells and tables (default: runs/tune_<name>)");
  const std::string& file = value("--write FILE", "configuration to write (default: CONFIG.tuned.yaml next to CONFIG)");
  const bool& replace = flag("--replace", "write over a configuration that tune did not write");
  const std::optional<int>& jobs =
      value_in<std::optional<int>>("--jobs N", {}, 1, 4096, "cells at a time (default: 1)");
  const std::vector<std::string>& devices =
      list("--devices LIST", "CUDA devices that cells run on, one cell at a time on each: all, or numbers (0,1)");
  const bool& dry_run = flag("--dry-run", "print rounds, cells and minutes, then stop");
};

// The shipped space of the preset that a configuration includes, or has the parts of.
std::string space_of(const RunConfig& config) {
  const bool contracted = config.rendering.outside == Outside::contracted, open = config.rendering.far == FarMode::open;
  return shared_file(std::string("configs/tune/") + (contracted ? "unbounded" : open ? "object" : "room") + ".yaml");
}

// Rounds as FOLDER/tune.json has them, and their cells in this process.
class TuneCells final : public TuneWork {
 public:
  TuneCells(TunePlan& plan, const CellOptions& own, CellHooks hooks, AppContext& context, bool dry)
      : plan_(plan), own_(own), hooks_(std::move(hooks)), context_(context), dry_(dry) {
    hooks_.finished = [this](const CellOutcome& outcome) { finished(outcome); };
    const TuneChoice base(plan.axes.size(), -1);
    identity_ = fmt::format("{} {} {} {}", tune_cell(plan, base, plan.length, 0, context.registry).id, plan.time_s,
                            plan.seeds, plan.aim);
    for (const TuneAxis& axis : plan.axes)
      for (const TuneValue& value : axis.values) {
        identity_ += "; " + value.name;
        for (const ConfigOverride& over : value.set)
          identity_ += " " + over.key + ": " + write_config_inline(over.value);
      }
    told_ = read_record();
    if (told_.value("of", "") != identity_)
      throw Error(ErrorKind::cannot_create, "tune.folder.other",
                  fmt::format("'{}' holds a race of another configuration, space or plan", own.folder),
                  "name another folder with --out, or remove this one");
    if (!told_["rounds"].empty()) before_s_ = told_["rounds"].back()["spent_s"];
    std::error_code none;
    if (own.place == 0)
      for (const auto& entry : fs::directory_iterator(fs::path(own.folder) / "cells", none))
        forget_cell_failure(own.folder, entry.path().filename());  // what failed is tried again
  }

  TuneRound agreed(const TuneRound& wanted) override {
    FolderLock alone;
    if (!dry_) {
      alone = lock_when_free(own_.folder, [&](const std::string& text) { print_note(context_, text); });
      told_ = read_record();
    }
    Json& rounds = told_["rounds"];
    if (rounds_ == rounds.size()) {
      rounds.push_back({{"name", wanted.name}, {"length", wanted.length}, {"seeds", wanted.seeds}});
      rounds.back().update({{"candidates", wanted.candidates}, {"spent_s", spent_s()}, {"cell_s", cell_s_}});
      if (!dry_) write_file_atomic(record(), told_.dump(1) + "\n");
    }
    const Json& known = rounds[rounds_++];
    cell_s_ = known["cell_s"];
    return {known["name"], known["length"], known["seeds"], known["candidates"]};
  }

  std::optional<TuneScores> run(const TuneRound& round) override {
    std::vector<std::vector<Cell>> cells(round.candidates.size());
    std::vector<Cell> waiting;
    for (std::size_t c = 0; c < cells.size(); ++c)
      for (int seed = 0; seed < round.seeds; ++seed) {
        cells[c].push_back(tune_cell(plan_, round.candidates[c], round.length, seed, context_.registry));
        if (ids_.insert(cells[c].back().id).second) waiting.push_back(cells[c].back());
      }
    const double cost_s = std::ceil(static_cast<double>(waiting.size()) / plan_.at_a_time) *
                          (cell_s_ + round.length * (plan_.in_steps ? step_s_ : 1));
    print_note(context_, fmt::format("{:<14} {:>3} candidates of {} seeds for {:g} {}: {} cells, about {}", round.name,
                                     round.candidates.size(), round.seeds, round.length, plan_.in_steps ? "steps" : "s",
                                     waiting.size(), minutes_text(cost_s)));
    if (dry_) {
      dry_s_ += cost_s;
      return imagined(round);
    }
    besides_s_ = ran_ = 0;
    if (!run_cells(waiting, own_, ended_, hooks_)) return std::nullopt;
    TuneScores scores(cells.size());
    for (std::size_t c = 0; c < cells.size(); ++c)
      for (const Cell& cell : cells[c]) scores[c].push_back(ended_.results[cell.id]);
    if (rounds_ == 1) plan_.score_stride = score_stride_for(plan_, scores[0][0]);
    return scores;
  }

  double spent_s() const override {
    return dry_ ? dry_s_ : before_s_ + std::chrono::duration<double>(std::chrono::steady_clock::now() - begin_).count();
  }
  double cell_s() const override { return cell_s_; }
  std::size_t cells() const { return ids_.size(); }

 private:
  std::string record() const { return (fs::path(own_.folder) / "tune.json").string(); }
  Json read_record() const {
    if (dry_ || !is_there(record())) return {{"of", identity_}, {"rounds", Json::array()}};
    const Json told = Json::parse(read_text_file(record()), nullptr, false);
    return told.is_object() ? told : Json::object();
  }

  void finished(const CellOutcome& outcome) {
    std::map<std::string, double> values;
    for (const auto& [name, value] : ended_.results[outcome.cell->id]) values[name] = value;
    if (!outcome.failure.empty()) return print_note(context_, outcome.cell->label + ": " + outcome.failure);
    besides_s_ += outcome.seconds - values["train_s"];
    cell_s_ = besides_s_ / ++ran_;
    step_s_ = values["train_s"] / values["steps"];
  }

  // Every value gains: what the most rounds cost.
  TuneScores imagined(const TuneRound& round) const {
    TuneScores scores;
    for (const TuneChoice& choice : round.candidates) {
      const auto gains = static_cast<double>(std::count_if(choice.begin(), choice.end(), [](int v) { return v >= 0; }));
      CellValues values{{"psnr", 20 + gains}, {"miou_present", gains / 100}, {"absrel", 1 / (1 + gains)}};
      values.insert(values.end(), {{"train_s", 1000 * step_s_ / (1 + gains / 100)}, {"steps", 1000}});
      scores.emplace_back(static_cast<std::size_t>(round.seeds), std::move(values));
    }
    return scores;
  }

  TunePlan& plan_;
  const CellOptions& own_;
  CellHooks hooks_;
  AppContext& context_;
  bool dry_;
  std::string identity_;
  Json told_;
  std::size_t rounds_ = 0;
  double before_s_ = 0, dry_s_ = 0, besides_s_ = 0;
  double cell_s_ = 1.5, step_s_ = 0.02;  // what cells of a round take besides training, and a step: guesses at first
  int ran_ = 0;
  std::set<std::string> ids_;
  EndedCells ended_;
  std::chrono::steady_clock::time_point begin_ = std::chrono::steady_clock::now();
};

// Values that the configuration has already are no candidates; what it cannot take is an error, or passed over where
// the space is a shipped one.
void drop_values(TunePlan& plan, bool shipped, Registry& registry) {
  TunePlan one = plan;  // of a single value
  for (TuneAxis& axis : plan.axes)
    std::erase_if(axis.values, [&](const TuneValue& value) {
      one.axes = {{axis.name, {value}}};
      try {
        return tune_cell(one, {0}, 16, 0, registry).id == tune_cell(one, {-1}, 16, 0, registry).id;
      } catch (const Error&) {
        if (!shipped && !axis.is_part) throw;
        return true;
      }
    });
  std::erase_if(plan.axes, [](const TuneAxis& axis) { return axis.values.empty(); });
}

TunePlan tune_plan(const TuneOptions& options, const RunConfig& config) {
  const std::optional<long long> none;
  TunePlan plan;
  plan.time_s = asked_length({options.time, none}).seconds;
  plan.seeds = options.seeds;
  plan.aim = options.aim;
  const AskedLength asked = asked_length({options.length, options.steps}), own{config.train.steps, config.train.time_s};
  const AskedLength& length = asked.any() ? asked : own;
  plan.in_steps = length.steps > 0;
  plan.length = plan.in_steps        ? static_cast<double>(length.steps)
                : length.seconds > 0 ? length.seconds
                                     : plan.time_s / 8;
  if (plan.aim == "time" && !plan.in_steps)
    throw Error(ErrorKind::usage, "usage.flag.conflict", "tune: --for time compares trainings of equally many steps",
                "give their number with --steps");
  return plan;
}

int run(const TuneOptions& options, AppContext& context) {
  const bool helps = Helpers::own_number() > 0;
  context.quiet = context.quiet || helps;
  const std::string path = find_config(options.config);
  const ConfigNode config = compose_config(path);
  const RunConfig read = run_config_of(config, context.registry);
  TunePlan plan = tune_plan(options, read);
  plan.config = config;
  plan.path = path;
  Share share{named_devices(options.devices)};
  share.jobs = share.devices.empty() ? options.jobs.value_or(1) : static_cast<int>(share.devices.size());
  share.threads = std::max(1, thread_count() / share.jobs);
  const std::string folder = options.out.empty() ? "runs/tune_" + fs::path(path).stem().string() : options.out;
  TrainHere here{context.registry};
  CellOptions own = cell_options(share, folder, context.registry);
  own.here = &here;
  plan.at_a_time = share.jobs;

  const fs::path beside = fs::path(options.config).parent_path() / fs::path(path).stem();
  const std::string file = options.file.empty() ? beside.string() + ".tuned.yaml" : options.file;
  if (is_there(file) && !options.replace && !read_text_file(file).starts_with(kTunedBy))
    throw Error(ErrorKind::cannot_create, "files.output.exists",
                "'" + file + "' is there already, and tune did not write it",
                "name another file with --write, or give --replace to overwrite it");
  const bool shipped = options.space.empty();
  plan.axes = read_tune_space(shipped ? space_of(read) : options.space);
  for (TuneAxis& part : optional_parts(config)) plan.axes.push_back(std::move(part));
  drop_values(plan, shipped, context.registry);

  install_stop_signals(!context.quiet);
  Helpers helpers(helps || options.dry_run ? 0 : share.jobs - 1);
  TuneCells cells(plan, own, hooks_of(helpers, context), context, options.dry_run);
  const TuneOutcome outcome = race(plan, cells);
  if (options.dry_run) {
    print_results(context, {{"folder", folder}, {"cells", cells.cells()}, {"time_s", cells.spent_s()}},
                  fmt::format("tune: cells={} time_s={:.0f} folder={}", cells.cells(), cells.spent_s(), folder));
    return 0;
  }
  if (!outcome.whole) {
    print_note(context, "stopped; the same command continues the race");
    return 128 + stop_signal();
  }
  if (helps) return 0;
  const std::string best = choice_name(plan.axes, outcome.best);
  const std::string page = (fs::path(folder) / "tune.html").string(), unit = tune_aim(plan.aim).unit;
  const auto [markdown, json] = tune_tables(plan, outcome);
  write_file_atomic((fs::path(folder) / "tables.md").string(), markdown);
  write_file_atomic(page, report_page(json));
  const bool named = is_there(options.config) || is_there(options.config + ".yaml");  // else it is a shipped one
  const fs::path include = named ? fs::proximate(path, fs::absolute(file).parent_path()) : fs::path(path).filename();
  write_file_atomic(file, tuned_config(plan, outcome, include.string(), "semfield " + context.words));
  const TuneGain& gain = outcome.gain;
  const Json found{{"folder", folder},        {"cells", cells.cells()}, {"best", best},
                   {"gain", gain.mean},       {"unit", unit},           {"noise", outcome.noise},
                   {"seeds_sure", gain.sure}, {"seeds", gain.seeds},    {"time_s", cells.spent_s()},
                   {"report", page},          {"config", file}};
  std::string text =
      gain.seeds > 0 ? best + ": " + gain_text(tune_aim(plan.aim), gain) : "no setting gains more than noise";
  std::string word = best;  // without blanks
  std::replace(word.begin(), word.end(), ' ', '_');
  text += fmt::format("\ntune: cells={} best={} gain={:.3f} time_s={:.0f} config={}", cells.cells(), word, gain.mean,
                      cells.spent_s(), file);
  print_results(context, found, text);
  print_next(context, {{"train " + shell_word(file), "trains with what won"}});
  return 0;
}

}  // namespace

Verb verb_tune() {
  return make_verb<TuneOptions>("tune", 45, "find the settings that a scene's own held-out views ask for",
                                {"configs/my_photos.yaml --time 2m", "configs/my_photos.yaml --for depth --dry-run"},
                                run, Launch::beside);
}

// demo: the verbs that make a labelled scene, one after the other, on the shipped room.

namespace {

constexpr const char* kOwnFolder = "runs/demo";
constexpr const char* kSettings[] = {"report.eval_share=0",  // figures of every test frame, on a slow machine too
                                     "report.eval_every_s=45", "report.eval_frames=3", "name=demo",
                                     "scene.width_px=320",     "scene.height_px=240",  "scene.test_frames=20"};
constexpr const char* kSteps = "4500";

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
  const std::size_t at = out.rfind("train: ");
  const std::regex others("(steps|trained_s|peak_mb)=\\S* |\\s+$");
  return std::regex_replace(out.substr(at == std::string::npos ? 0 : at + 7), others, "");
}

// A held-out view to show to others: photograph and colour, labels over colour and depth. Of the views that the report
// shows the last one, which looks across the room. Returns the file's path; "" where no view has all of them.
std::string write_first_picture(const std::string& run_dir) {
  constexpr const char* kTruth = "_rgb_truth.png";
  constexpr std::int32_t kGap_px = 4;
  std::string last;
  std::error_code unknown;
  for (const auto& entry : fs::directory_iterator(fs::path(run_dir) / "render" / "test", unknown))
    if (const std::string file = entry.path().string(); file.ends_with(kTruth)) last = std::max(last, file);
  if (last.empty()) return {};
  const std::string stem = last.substr(0, last.size() - std::string_view(kTruth).size());
  std::vector<Image<std::uint8_t>> parts;
  for (const char* kind : {kTruth, "_rgb.png", "_label_vis.png", "_depth_vis.png"}) {
    if (!is_file(stem + kind)) return {};
    parts.push_back(read_rgb(stem + kind));
  }
  for (std::size_t i = 0; i < parts[2].pixels.size(); ++i)
    parts[2].pixels[i] = static_cast<std::uint8_t>((parts[1].pixels[i] + parts[2].pixels[i] + 1) / 2);
  const std::int32_t width = parts[0].width_px, height = parts[0].height_px, row = 2 * width + kGap_px;
  std::vector<std::uint8_t> all(3 * static_cast<std::size_t>(row) * static_cast<std::size_t>(2 * height + kGap_px),
                                255);
  for (std::size_t p = 0; p < parts.size(); ++p) {
    const std::int64_t left = p % 2 == 0 ? 0 : width + kGap_px, top = p < 2 ? 0 : height + kGap_px;
    for (std::int64_t y = 0; y < height; ++y)
      std::copy_n(parts[p].pixels.begin() + 3 * y * width, 3 * width, all.begin() + 3 * ((top + y) * row + left));
  }
  const std::string path = (fs::path(run_dir) / "first_look.png").string();
  write_png_rgb(path, row, 2 * height + kGap_px, all);
  return path;
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
  const std::string named = find_config("quickstart") == config ? "quickstart" : config;
  std::vector<std::string> train{"train", named, "--out", out};
  for (const char* setting : kSettings) train.insert(train.end(), {"--set", setting});
  for (const std::string& setting : options.set) {
    // "--threads runtime.threads=2" was typed as "--threads 2".
    train.push_back("--set");
    train.push_back(setting.starts_with("--") ? setting.substr(setting.find(' ') + 1) : setting);
  }
  const bool timed = !options.length.time.empty();
  train.insert(train.end(),
               {timed ? "--time" : "--steps", timed                  ? options.length.time
                                              : options.length.steps ? std::to_string(*options.length.steps)
                                                                     : kSteps});
  const std::string program = typed_program();
  install_stop_signals(!context.quiet);
  std::string figures;
  for (std::vector<std::string> words :
       {train, {"render", out, "--split", "test"}, {"mesh", out, "--resolution", "160", "--format", "ply,glb"}}) {
    std::string shown = program;
    for (const std::string& word : words) shown += " " + shell_word(word);
    print_note(context, "$ " + shown);
    words.insert(words.begin(), own_program());
    if (context.quiet) words.push_back("--quiet");
    if (context.json) words.push_back("--json");
    leave_next_out_of_children(true);
    const ChildEnd end = run_child(words);
    leave_next_out_of_children(false);
    print_note(context, end.out.substr(0, end.out.find_last_not_of('\n') + 1));
    if (end.code != 0) return end.code;
    if (figures.empty()) figures = context.json ? end.out : figures_of(end.out);
  }
  const std::string folder = shell_word(out), picture = write_first_picture(out);
  print_note(
      context,
      fmt::format("\nThe room is labelled, from labels of a tenth of its frames. {}The report is {}/report.html, the "
                  "labelled mesh {}/mesh_classes.glb, and {}/render/test has every unseen view.",
                  picture.empty() ? ""
                                  : "Look at " + picture +
                                        " first: an unseen view, photograph and "
                                        "rendered colour above labels and depth. ",
                  out, out, out));
  std::vector<NextStep> next = next_of_look(out);
  next.push_back({"eval " + folder, "every figure of its unseen views"});
  next.push_back({"train --resume " + folder + " --time 5m", "sharper, in five minutes more"});
  next.push_back({"help init", "for photographs of your own; docs/guide/own_data.md says more"});
  print_next(context, next, program);
  Json found = context.json ? Json::parse(figures) : Json::object();  // by `train`
  found.erase("semfield");
  found.erase("verb");
  print_results(context, found, "demo: " + figures);
  return 0;
}

}  // namespace

Verb verb_demo() {
  return make_verb<DemoOptions>("demo", 5, "train on the shipped room, render its held-out views and write its mesh",
                                {"", "--time 60s --out runs/my_demo"}, run);
}

}  // namespace semfield::app
