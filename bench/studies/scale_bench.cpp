#include "studies/scale_bench.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstdlib>
#include <ctime>
#include <filesystem>
#include <set>

#include "core/error.h"
#include "execution/device_library.h"
#include "run/run_folder.h"
#include "run/run_scores.h"
#include "studies/scale_trainings.h"
#include "system/files.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;

std::string today() {
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  ::gmtime_r(&now, &utc);
  return fmt::format("{:04}-{:02}-{:02}", utc.tm_year + 1900, utc.tm_mon + 1, utc.tm_mday);
}

// What else the machine did before the study began; figures of a busy machine are no figures of the program.
std::string load_text() {
  double minute = 0;
  return getloadavg(&minute, 1) == 1 ? fmt::format(", load {:.1f} before", minute) : std::string();
}

// Powers of two, so that every measurement halves the one before.
std::vector<int> counts_to(int most) {
  std::vector<int> counts;
  for (int count = 1; count <= most; count *= 2) counts.push_back(count);
  return counts;
}

std::string ranks_text(int ranks) { return ranks == 1 ? "one rank" : fmt::format("{} ranks", ranks); }

class ScaleBench {
 public:
  ScaleBench(const ScaleBenchOptions& options, const ScaleTools& tools) : options_(options), tools_(tools) {
    results_.quick = options.quick;
    const Environment environment = this_environment();
    const std::string build = fmt::format("{}, {}, {}, {}{}", environment.version, environment.compiler,
                                          environment.build_type, today(), load_text());
    cpu_ = {fmt::format("{}, {} cores", environment.cpu, tools.cores), "cpu", tools.cores, build};
    std::string why_not;
    int gpus = 0;
    while (cuda_available(gpus == 0 ? &why_not : nullptr, gpus)) ++gpus;
    if (gpus > 0) {
      gpu_ = {fmt::format("{} x {}", gpus, cuda_library().describe(0)), "cuda", gpus, build};
    } else {
      no_gpu_ = why_not;
    }
  }

  ScaleResults run() {
    if (wanted("cpu")) processors();
    if (wanted("gpu")) devices();
    if (wanted("bits")) bits();
    if (wanted("sweep")) sweep();
    return std::move(results_);
  }

 private:
  bool wanted(const std::string& part) const {
    return options_.only.empty() || std::find(options_.only.begin(), options_.only.end(), part) != options_.only.end();
  }
  bool allowed(int ranks) const { return options_.most_ranks == 0 || ranks <= options_.most_ranks; }
  int most(int units) const { return options_.most_ranks > 0 ? std::min(options_.most_ranks, units) : units; }
  void miss(const std::string& what, const std::string& why) { results_.missing.push_back(what + ": " + why); }
  std::string config(const std::string& preset) const { return tools_.study.shared_file("configs/" + preset); }

  bool has_ranks(const std::string& device) const { return !no_ranks_.contains(device); }

  // False where ranks cannot be had on this device; the reason is then among what is missing.
  bool start(const ScaleStart& start, const std::string& device, const std::string& what, double* seconds = nullptr) {
    const ScaleEnd end = tools_.start(start);
    if (seconds != nullptr) *seconds = end.seconds;
    if (end.code == 0) return true;
    if (end.code != static_cast<int>(ErrorKind::unavailable) || start.ranks == 1) {
      throw Error(ErrorKind::failure, "study.process.failed",
                  fmt::format("{} on {} failed: {}", what, ranks_text(start.ranks), end.failure),
                  "fix its cause, or leave the part out with --only");
    }
    miss(fmt::format("{} on {} ({})", what, ranks_text(start.ranks), device), end.failure);
    no_ranks_.insert(device);
    return false;
  }

  // Every training of the list once per round, so that what drifts meets all alike.
  void measure(const ScaleMachine& machine, std::vector<ScaleTraining> trainings) {
    if (std::any_of(trainings.begin(), trainings.end(), [](const ScaleTraining& t) { return t.ranks > 1; }))
      tools_.need_ranks();
    results_.machines.push_back(machine);
    std::vector<std::vector<double>> seconds(trainings.size());
    std::vector<GradientBytes> bytes(trainings.size());
    for (int round = 0; round < options_.repeats; ++round) {
      for (std::size_t i = 0; i < trainings.size(); ++i) {
        const ScaleTraining& training = trainings[i];
        if (training.ranks > 1 && !has_ranks(training.device)) continue;
        const std::string what = fmt::format("{} step of {} rays", training.step, training.rays);
        tools_.study.note(fmt::format("round {} of {}: {} on {} ({})", round + 1, options_.repeats, what,
                                      ranks_text(training.ranks), training.device));
        const std::string run = next_run();
        if (!start({training.ranks, training.device == "cpu", training_words(training, tools_.folder, run)},
                   training.device, what))
          continue;
        const std::vector<double> batches = batch_seconds(run);
        seconds[i].insert(seconds[i].end(), batches.begin(), batches.end());
        bytes[i] = gradient_bytes(run);
        remove(run);
      }
    }
    for (std::size_t i = 0; i < trainings.size(); ++i) {
      if (seconds[i].empty()) continue;
      const ScaleTraining& t = trainings[i];
      results_.rows.push_back({machine.name, t.step, t.device, t.ranks, t.rays, spread_of(seconds[i]),
                               std::ssize(seconds[i]), bytes[i].dense, bytes[i].table});
    }
  }

  // Without those that are there already: a weak step on some ranks may be the strong one.
  void add(std::vector<ScaleTraining>& to, ScaleTraining training) const {
    const bool known = std::any_of(to.begin(), to.end(), [&](const ScaleTraining& t) {
      return t.step == training.step && t.ranks == training.ranks && t.rays == training.rays;
    });
    if (!known) to.push_back(std::move(training));
  }

  std::vector<ScaleTraining> steps_on(const std::string& device, int units) const {
    std::vector<ScaleTraining> all;
    for (const std::string step : {"paper", "hash"}) {
      const ScaleSizes sizes = scale_sizes(step, device, options_.quick);
      const auto training = [&](int ranks, std::int64_t rays) {
        return preset_training(step, device, ranks, rays, options_.quick, tools_.study);
      };
      add(all, training(1, sizes.few));
      for (const int ranks : counts_to(most(units))) {
        add(all, training(ranks, sizes.strong));
        if (step == "paper" || device == "cuda") add(all, training(ranks, sizes.weak * ranks));
      }
    }
    return all;
  }

  void processors() {
    if (tools_.cores < 2) miss("cpu2_strong, cpu2_weak", "this machine has one core");
    if (tools_.cores < 16)
      miss("cpu16_strong", fmt::format("it takes 16 cores, and this machine has {}", tools_.cores));
    if (most(tools_.cores) < std::min(tools_.cores, 16))
      miss("steps on more ranks", fmt::format("--ranks asks for no more than {}", options_.most_ranks));
    measure(cpu_, steps_on("cpu", tools_.cores));
  }

  void devices() {
    if (gpu_.name.empty()) {
      miss("steps on GPUs", no_gpu_);
      return;
    }
    if (gpu_.units < 2) miss("gpu2_weak_paper, gpu2_strong_paper4096, gpu2_weak_hash", "this machine has one GPU");
    measure(gpu_, steps_on("cuda", gpu_.units));
  }

  // The same training in every arrangement of ranks and threads; the first is what the others are compared with.
  void compare(const ScaleMachine& machine, const std::string& name, ScaleTraining training,
               const std::vector<std::pair<int, int>>& arrangements) {
    std::string reference;
    for (const auto& [ranks, threads] : arrangements) {
      if (ranks > 1 && (!has_ranks(training.device) || !allowed(ranks))) continue;
      training.ranks = ranks;
      training.threads = threads;
      tools_.study.note(fmt::format("bits of {}: {}, threads of each: {}", name, ranks_text(ranks), threads));
      const std::string run = next_run();
      if (!start({ranks, false, training_words(training, tools_.folder, run)}, training.device, name)) continue;
      ScaleBits bits{machine.name, name, ranks, threads, ""};
      if (reference.empty()) {
        reference = run;
      } else {
        Diagnostics diagnostics;
        bits.difference = compare_runs(reference, run, tools_.study.registry, diagnostics).difference;
        remove(run);
      }
      results_.bits.push_back(std::move(bits));
    }
    if (!reference.empty()) remove(reference);
  }

  void bits() {
    if (allowed(2)) {
      tools_.need_ranks();
    } else {
      miss("bits of several ranks", "--ranks asks for no more than 1");
    }
    if (!has_machine(cpu_)) results_.machines.push_back(cpu_);
    const std::vector<std::string> presets = options_.quick
                                                 ? std::vector<std::string>{"quickstart"}
                                                 : std::vector<std::string>{"quickstart", "quickstart_frequency"};
    std::vector<std::pair<int, int>> arrangements{{1, 1}, {1, 2}, {2, 1}, {2, 2}, {3, 1}, {3, 2}};
    if (options_.quick) arrangements = {{1, 1}, {1, 2}, {2, 1}};
    for (const std::string& preset : presets)
      compare(cpu_, preset, bits_training(config(preset + ".yaml"), "cpu", options_.quick, tools_.study), arrangements);
    if (gpu_.name.empty()) {
      miss("bits on GPUs", no_gpu_);
      return;
    }
    if (!has_machine(gpu_)) results_.machines.push_back(gpu_);
    if (gpu_.units < 2) tools_.study.note("bits on GPUs: this machine has one GPU, which two ranks share");
    std::vector<std::pair<int, int>> on_devices{{1, 1}, {2, 1}};
    if (gpu_.units >= 4) on_devices.emplace_back(4, 1);
    for (const std::string& preset : presets) {
      compare(gpu_, preset + (gpu_.units < 2 ? ", ranks share one GPU" : ", deterministic"),
              bits_training(config(preset + ".yaml"), "cuda", options_.quick, tools_.study), on_devices);
    }
  }

  bool has_machine(const ScaleMachine& machine) const {
    return std::any_of(results_.machines.begin(), results_.machines.end(),
                       [&](const ScaleMachine& m) { return m.name == machine.name; });
  }

  // Two GPUs where there are two, else two processes of one thread.
  void sweep() {
    const bool on_devices = gpu_.units >= 2 && !gpu_.name.empty();
    const ScaleMachine& machine = on_devices ? gpu_ : cpu_;
    if (!on_devices && tools_.cores < 2) {
      miss("sweep2", "this machine has one core and no two GPUs");
      return;
    }
    if (!allowed(2)) {
      miss("sweep2", "--ranks asks for no more than 1");
      return;
    }
    if (!on_devices && !has_ranks("cpu")) {
      miss("sweep2", "ranks cannot be started here");
      return;
    }
    if (!on_devices) tools_.need_ranks();
    const int cells = options_.quick ? 2 : 8;
    const std::string file =
        sweep_file(cells, on_devices ? "cuda" : "cpu", options_.quick, tools_.study, tools_.folder);
    const auto words = [&](const std::string& out, const char* devices) {
      std::vector<std::string> all{"sweep", file, "--out", out, "--threads", "1", "-q"};
      if (on_devices) {
        all.insert(all.end(), {"--devices", devices});
      } else {
        all.insert(all.end(), {"--jobs", "1"});
      }
      return all;
    };
    ScaleSweep row{machine.name, on_devices ? "GPUs" : "processes of one thread", cells, 0, 0};
    for (const bool two : {false, true}) {
      tools_.study.note(
          fmt::format("a sweep of {} cells by {} ({})", cells, two ? "two workers" : "one worker", row.workers));
      const std::string out = next_run();
      if (!start({two && !on_devices ? 2 : 1, false, words(out, two ? "0,1" : "0")}, machine.device, "a sweep",
                 two ? &row.two_s : &row.one_s))
        return;
      remove(out);
    }
    if (!has_machine(machine)) results_.machines.push_back(machine);
    results_.sweeps.push_back(row);
  }

  std::string next_run() { return (fs::path(tools_.folder) / fmt::format("run_{}", ++runs_)).string(); }
  static void remove(const std::string& folder) {
    std::error_code ignored;  // it costs disk alone
    fs::remove_all(folder, ignored);
  }

  const ScaleBenchOptions& options_;
  const ScaleTools& tools_;
  ScaleMachine cpu_, gpu_;
  std::string no_gpu_;
  std::set<std::string> no_ranks_;  // devices
  int runs_ = 0;
  ScaleResults results_;
};

}  // namespace

ScaleResults measure_scale(const ScaleBenchOptions& options, const ScaleTools& tools) {
  return ScaleBench(options, tools).run();
}

}  // namespace semfield
