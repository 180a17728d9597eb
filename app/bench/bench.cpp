// bench: training steps and frames of every case, timed in turn, as a table or JSON.
#include "app/bench/bench.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <functional>
#include <memory>
#include <string_view>

#include "app/app_context.h"
#include "app/bench/step_case.h"
#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/error.h"
#include "core/files.h"
#include "execution/device_library.h"
#include "train/run_folder.h"

namespace semfield::app {

namespace {

constexpr std::int64_t kFrameRays = 320 * 240;

/// What takes its turn in every round: `steps` training steps, or a frame. "hash 15" has 2^15 entries a level.
struct Case {
  std::string_view net, precision = "fp32";
  int classes = 29;
  std::int64_t rays = 1024;
  int steps = 1;
  int threads = 0;  ///< 0: as many as were asked for
  bool deterministic = false, frame = false;
};

// Steps over networks and precisions; over the number of classes, with fewer rays for the paper's network; over
// threads.
std::vector<Case> cpu_cases() {
  std::vector<Case> cases{{"paper"},
                          {"paper", "bf16"},
                          {"hash 15", "fp32", 29, 1024, 20},
                          {"hash 15", "bf16", 29, 1024, 20},
                          {"hash 17", "fp32", 29, 1024, 20},
                          {"hash 17", "bf16", 29, 1024, 20}};
  for (const int classes : {13, 101, 512, 0}) {
    cases.push_back({"paper", "fp32", classes, 256});
    cases.push_back({"hash 15", "fp32", classes, 1024, 20});
  }
  constexpr int kMany = 16, kFewest = 8;
  std::vector<int> threads;
  if (hardware_threads() >= 2) threads = {1, 2};
  if (hardware_threads() >= kFewest) threads.push_back(std::min(kMany, hardware_threads()));
  for (const int n : threads) {
    cases.push_back({"paper", "fp32", 29, 1024, 1, n});
    cases.push_back({"hash 15", "fp32", 29, 1024, 20, n});
  }
  return cases;
}

// Steps of the hash grid have 8192 rays of 32 samples: 2^18.
std::vector<Case> gpu_cases() {
  std::vector<Case> cases;
  for (const int classes : {29, 13, 512, 101, 0}) cases.push_back({"paper", "bf16", classes, 1024, 64});
  cases.push_back({"paper", "bf16", 29, 1024, 64, 0, true});
  cases.push_back({"paper", "fp32", 29, 1024, 8});
  for (const int classes : {29, 13, 512}) cases.push_back({"hash 19", "bf16", classes, 8192, 128});
  cases.push_back({"hash 19", "bf16", 29, 8192, 128, 0, true});
  cases.push_back({"hash 19", "fp32", 29, 8192, 128});
  cases.push_back({"paper", "bf16", 29, kFrameRays, 1, 0, false, true});
  return cases;
}

std::string name_of(const Case& c) {
  return fmt::format("{}{} {} C={}{}{}", c.frame ? "frame " : "", c.net, c.precision, c.classes,
                     c.deterministic ? " deterministic" : "", c.threads > 0 ? fmt::format(" on {}", c.threads) : "");
}

StepCaseOptions options_of(const Case& c, const std::string& device, const BenchOptions& asked) {
  StepCaseOptions o;
  const bool paper = c.net == "paper", cuda = device == "cuda", tiny = asked.size == "tiny";
  o.config = shared_file(paper ? "configs/paper.yaml" : "configs/bench/hash_step.yaml");
  o.classes = c.classes;
  o.rays = tiny ? 32 : c.frame ? 1024 : c.rays;
  o.set = {"runtime.device=" + device, fmt::format("runtime.precision={}", c.precision)};
  if (c.deterministic) o.set.emplace_back("runtime.deterministic=true");
  if (paper && tiny) {
    o.set.insert(o.set.end(), {"passes.0.sampler.samples=8", "passes.1.sampler.samples=8", "semantics.hidden_width=16",
                               "passes.0.field.width=32", "passes.0.field.view_width=16"});
  }
  if (!paper) {
    o.set.push_back(fmt::format("passes.0.position.log2_entries={}", c.net.substr(c.net.find(' ') + 1)));
    o.set.push_back(fmt::format("passes.0.sampler.samples={}", tiny ? 8 : cuda ? 32 : 30));
    if (cuda) o.set.emplace_back("passes.0.position.finest_resolution=2048");
  }
  o.set.insert(o.set.end(), asked.set.begin(), asked.set.end());
  return o;
}

/// A measured case.
struct Row {
  Case of;
  std::string name;
  int threads = 0, steps = 1;
  std::shared_ptr<StepCase> step = {};
  std::int64_t rays = 0;
  std::vector<double> processor = {};  ///< processor seconds per step, summed over threads
  Spread seconds = {};
  double rate() const { return of.frame ? 0 : static_cast<double>(step->samples_per_step()) / seconds.median; }

  double take() {
    if (of.frame) return step->render_seconds(of.rays);
    StepCase::start_threads(threads);  // a team of another size would count as the step's time
    const std::clock_t begin = std::clock();
    const double took = step->seconds(threads, steps);
    const std::clock_t end = std::clock();
    processor.push_back(static_cast<double>(end - begin) / CLOCKS_PER_SEC / steps);
    return took;
  }
};

/// Every case whose name begins as asked, ready to be timed: memory has grown, algorithms are chosen and graphs
/// captured. What a GPU cannot hold is a note.
std::vector<Row> warm_rows(const BenchOptions& options, const std::string& device, AppContext& context) {
  std::vector<Row> rows;
  bool named = false;
  const bool cuda = device == "cuda";
  for (const Case& c : cuda ? gpu_cases() : cpu_cases()) {
    Row row{c, name_of(c)};
    if (!row.name.starts_with(options.only)) continue;
    named = true;
    print_note(context, "warming up: " + row.name);
    row.threads = c.threads > 0 ? c.threads : options.threads > 0 ? options.threads : hardware_threads();
    row.steps = options.size == "tiny" ? std::min(c.steps, 2) : c.steps;
    try {
      const StepCaseOptions made = options_of(c, device, options);
      row.rays = c.frame ? c.rays : made.rays;
      row.step = std::make_shared<StepCase>(made, context.registry);
      if (!c.frame) row.step->seconds(row.threads, cuda ? 5 : 1);
      row.take();
    } catch (const Error& error) {
      if (!cuda) throw;
      print_note(context, "not measured: " + row.name + ": " + error.what());
      continue;
    }
    row.processor.clear();
    rows.push_back(std::move(row));
  }
  if (!named) throw Error(ErrorKind::usage, "usage.value.invalid", "no measurement begins with '" + options.only + "'");
  return rows;
}

void print_table(const BenchOptions& options, const std::string& about, const std::vector<Row>& rows) {
  std::printf("%s\nmedians of %d rounds, every measurement once per round; networks and rays: %s\n", about.c_str(),
              options.repeats, options.size.c_str());
  std::printf("\n%-28s %12s  %-23s %7s %6s %10s %12s\n", "", "ms", "(min .. max)", "threads", "rays", "core ms",
              "samples/s");
  for (const Row& row : rows) {
    const std::string range = fmt::format("({:.3f} .. {:.3f})", 1e3 * row.seconds.min, 1e3 * row.seconds.max);
    std::printf("%-28s %12.3f  %-23s %7d %6lld %10.3f %12.0f\n", row.name.c_str(), 1e3 * row.seconds.median,
                range.c_str(), row.threads, static_cast<long long>(row.rays),
                row.processor.empty() ? 0 : 1e3 * spread_of(row.processor).median, row.rate());
  }
}

Json rows_json(const std::vector<Row>& rows) {
  Json all = Json::array();
  for (const Row& row : rows) {
    all.push_back({{"name", row.name},
                   {"net", row.of.net},
                   {"precision", row.of.precision},
                   {"threads", row.threads},
                   {"classes", row.of.classes},
                   {"rays", row.rays},
                   {"seconds", {{"median", row.seconds.median}, {"min", row.seconds.min}, {"max", row.seconds.max}}},
                   {"processor_s", row.processor.empty() ? Json() : Json(spread_of(row.processor).median)},
                   {"samples_per_s", row.rate()}});
  }
  return all;
}

}  // namespace
}  // namespace semfield::app

// By name, as the program finds it in the library. Throws Error(unavailable) without the device.
extern "C" int semfield_bench(const semfield::app::BenchOptions& options, const char* device,
                              semfield::app::AppContext& context);
int semfield_bench(const semfield::app::BenchOptions& options, const char* device, semfield::app::AppContext& context) {
  using namespace semfield;
  using namespace semfield::app;
  const Environment e = this_environment();
  const std::string gpu = device == std::string_view("cuda") ? cuda_library().describe(0) : "";
  if (!gpu.empty()) print_note(context, gpu);
  std::vector<Row> rows = warm_rows(options, device, context);
  print_note(context, fmt::format("{} rounds of {} measurements", options.repeats, rows.size()));
  std::vector<std::function<double()>> calls;
  for (Row& row : rows) calls.emplace_back([&row] { return row.take(); });
  const std::vector<Spread> spreads = alternate(calls, options.repeats);
  for (std::size_t i = 0; i < rows.size(); ++i) rows[i].seconds = spreads[i];
  const std::string kernels(isa_name(isa()));
  if (context.json) {
    Json out = Json::parse(environment_json(e));
    out["device"] = gpu.empty() ? device : gpu;
    out["repeats"] = options.repeats;
    out["size"] = options.size;
    out["isa"] = kernels;
    out["rows"] = rows_json(rows);
    print_json(context, out);
    return 0;
  }
  print_table(options,
              gpu.empty() ? fmt::format("{}, {} cores; matrix products: {}; {}, {}", e.cpu, e.hardware_threads, kernels,
                                        e.compiler, e.build_type)
                          : gpu,
              rows);
  return 0;
}
