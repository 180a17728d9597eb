// bench gpu: training steps and frames on a GPU, beside the same steps in PyTorch, as a table or JSON.
#include "app/bench/bench_studies.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <functional>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <string_view>
#include <vector>

#include "app/allocation_count.h"
#include "app/bench/step_case.h"
#include "app/json_output.h"
#include "compute/isa.h"
#include "compute/parallel.h"
#include "compute/peak_probe.h"
#include "core/error.h"
#include "execution/device_library.h"
#include "run/run_folder.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct GpuRow {
  std::string name;
  Spread seconds;
};

struct GpuResults {
  std::string about, peer_about;  ///< the device; who answered as peer
  std::vector<GpuRow> rows;

  std::optional<double> ms(const std::string& name) const {
    for (const GpuRow& row : rows) {
      if (row.name == name) return 1e3 * row.seconds.median;
    }
    return std::nullopt;
  }
  /// Of the peer's fastest mode.
  std::optional<double> best_peer_ms() const {
    std::optional<double> best;
    for (const GpuRow& row : rows) {
      if (row.name.starts_with("torch paper") && (!best || 1e3 * row.seconds.median < *best))
        best = 1e3 * row.seconds.median;
    }
    return best;
  }
  std::optional<double> ratio(const std::string& over, const std::string& under) const {
    const std::optional<double> a = ms(over), b = ms(under);
    return a && b ? std::optional<double>(*a / *b) : std::nullopt;
  }
};

constexpr std::int64_t kFrameRays = 320 * 240;
constexpr std::int64_t kHashRays = 8192;  // of 32 samples: 2^18
constexpr int kPaperSteps = 64, kHashSteps = 128;

/// What cannot be measured is a note. Throws Error(unavailable) without a device.
class GpuBench {
 public:
  GpuBench(const BenchGpuOptions& options, AppContext& context) : options_(options), context_(context) {}

  GpuResults run() {
    results_.about = cuda_library().describe(0);
    print_note(context_, results_.about);
    add_step("paper bf16 C=29", paper({"runtime.precision=bf16"}, 29), kPaperSteps);
    add_step("paper bf16 C=29 deterministic", paper({"runtime.precision=bf16", "runtime.deterministic=true"}, 29),
             kPaperSteps);
    for (const int classes : {13, 512, 101, 0}) {
      add_step(fmt::format("paper bf16 C={}", classes), paper({"runtime.precision=bf16"}, classes), kPaperSteps);
    }
    add_step("paper fp32 C=29", paper({}, 29), 8);
    for (const int classes : {29, 13, 512}) {
      add_step(fmt::format("hash bf16 C={}", classes), hash({"runtime.precision=bf16"}, classes), kHashSteps);
    }
    add_step("hash bf16 C=29 deterministic", hash({"runtime.precision=bf16", "runtime.deterministic=true"}, 29),
             kHashSteps);
    add_step("hash fp32 C=29", hash({}, 29), kHashSteps);
    add_frame("frame 320x240 bf16", paper({"runtime.precision=bf16"}, 29));
    add_peers();
    measure();
    return std::move(results_);
  }

 private:
  StepCaseOptions paper(std::vector<std::string> set, int classes) const {
    StepCaseOptions o;
    o.config = shared_file("configs/paper.yaml");
    o.set = std::move(set);
    o.classes = classes;
    return o;
  }
  StepCaseOptions hash(std::vector<std::string> set, int classes) const {
    StepCaseOptions o;
    o.config = shared_file("configs/bench/hash_step.yaml");
    o.set = std::move(set);
    o.set.insert(o.set.end(), {"passes.0.sampler.samples=32", "passes.0.position.log2_entries=19",
                               "passes.0.position.finest_resolution=2048"});
    o.classes = classes;
    o.rays = kHashRays;
    return o;
  }

  std::shared_ptr<StepCase> make(const std::string& name, StepCaseOptions options) {
    if (!name.starts_with(options_.only)) return nullptr;
    options.set.push_back("runtime.device=cuda");
    try {
      return std::make_shared<StepCase>(options, context_.registry);
    } catch (const Error& error) {
      print_note(context_, "not measured: " + name + ": " + error.what());
      return nullptr;
    }
  }

  void add_step(const std::string& name, const StepCaseOptions& options, int steps) {
    const std::shared_ptr<StepCase> step = make(name, options);
    if (!step) return;
    print_note(context_, "warming up: " + name);
    step->seconds(hardware_threads(), 5);  // sizes arenas, chooses algorithms, captures the graph
    names_.push_back(name);
    turns_.emplace_back([step, steps] { return step->seconds(hardware_threads(), steps); });
  }

  void add_frame(const std::string& name, const StepCaseOptions& options) {
    const std::shared_ptr<StepCase> step = make(name, options);
    if (!step) return;
    step->render_seconds(kFrameRays);
    names_.push_back(name);
    turns_.emplace_back([step] { return step->render_seconds(kFrameRays); });
  }

  void add_peers() {
    if (!options_.peers) return;
    try {
      peer_ = std::make_shared<Peer>(shared_file("studies/peers/semfield_peer.py"), options_.python, hardware_threads(),
                                     "cuda");
      results_.peer_about = peer_->description();
    } catch (const Error& error) {
      print_note(context_, std::string("no peer: ") + error.what());
      return;
    }
    std::vector<PeerRequest> requests;
    for (const char* mode : {"fp32", "tf32", "bf16", "bf16_compile"})
      requests.push_back({"paper", mode, 1024, 29, 0, 10});
    for (const PeerRequest& request : requests) {
      const std::string name = "torch " + request.net + " " + request.mode;
      try {
        print_note(context_, "warming up: " + name);
        PeerRequest warm_up = request;
        warm_up.steps = 5;
        peer_->measure(warm_up);
        names_.push_back(name);
        turns_.emplace_back([peer = peer_, request] { return peer->measure(request).seconds; });
      } catch (const Error& error) {
        print_note(context_, "not measured: " + name + ": " + error.what());
      }
    }
  }

  void measure() {
    print_note(context_, fmt::format("{} rounds of {} measurements", options_.repeats, turns_.size()));
    const std::vector<Spread> spreads = alternate(turns_, options_.repeats);
    for (std::size_t i = 0; i < spreads.size(); ++i) results_.rows.push_back({names_[i], spreads[i]});
  }

  BenchGpuOptions options_;
  AppContext& context_;
  std::shared_ptr<Peer> peer_;
  std::vector<std::string> names_;
  std::vector<std::function<double()>> turns_;
  GpuResults results_;
};

constexpr double kLimit_ms =
    1.09;  // of the paper step's multiply-adds in bf16 at 790 TFLOP/s, a good product on an H200

std::string text_of(const std::optional<double>& value, int digits) {
  return value ? fmt::format("{:.{}f}", *value, digits) : "n/a";
}

int bench_gpu(const BenchGpuOptions& options, AppContext& context) {
  const GpuResults bench = GpuBench(options, context).run();
  const std::optional<double> step = bench.ms("paper bf16 C=29"), peer = bench.best_peer_ms();
  const std::optional<double> frame = bench.ms("frame 320x240 bf16");
  const std::vector<std::pair<std::string, std::string>> goals{
      {"step_ms", text_of(step, 3)},
      {"torch_best_ms", text_of(peer, 2)},
      {"P5", text_of(step && peer ? std::optional<double>(*peer / *step) : std::nullopt, 2)},
      {"P6", text_of(step ? std::optional<double>(*step / kLimit_ms) : std::nullopt, 2)},
      {"P7", text_of(std::max(bench.ratio("paper bf16 C=512", "paper bf16 C=13"),
                              bench.ratio("hash bf16 C=512", "hash bf16 C=13")),
                     3)},
      {"P8", text_of(bench.ratio("paper bf16 C=101", "paper bf16 C=0"), 3)},
      {"P11", text_of(std::max(bench.ratio("paper bf16 C=29 deterministic", "paper bf16 C=29"),
                               bench.ratio("hash bf16 C=29 deterministic", "hash bf16 C=29")),
                      3)},
      {"frame_fps", text_of(frame ? std::optional<double>(1e3 / *frame) : std::nullopt, 1)},
      {"hash_ms", text_of(bench.ms("hash bf16 C=29"), 3)}};
  if (context.json) {
    Json out{{"device", bench.about}, {"peer", bench.peer_about}};
    for (const GpuRow& row : bench.rows)
      out["ms"][row.name] = {1e3 * row.seconds.median, 1e3 * row.seconds.min, 1e3 * row.seconds.max};
    for (const auto& [name, value] : goals) out["goals"][name] = value;
    print_json(context, out);
    return 0;
  }
  std::printf("device     %s\n", bench.about.c_str());
  if (!bench.peer_about.empty()) std::printf("peer       %s\n", bench.peer_about.c_str());
  std::printf("medians of %d rounds, every measurement once per round\n%-32s %10s  %s\n", options.repeats, "", "ms",
              "(min .. max)");
  for (const GpuRow& row : bench.rows) {
    std::printf("%-32s %10.3f  (%.3f .. %.3f)\n", row.name.c_str(), 1e3 * row.seconds.median, 1e3 * row.seconds.min,
                1e3 * row.seconds.max);
  }
  std::string line = "bench gpu:";
  for (const auto& [name, value] : goals) line += " " + name + "=" + value;
  std::printf("%s\n", line.c_str());
  return 0;
}

// bench step: whole training steps, the machine's limits and the peer, as a table or one JSON object.

/// A measured training step of ours.
struct StepRow {
  std::string net;        ///< paper, hash T=2^15, ...
  std::string precision;  ///< fp32, bf16
  int threads = 0, classes = 0;
  std::int64_t rays = 0;
  Spread seconds;
  double processor = 0;  ///< processor seconds per step, summed over threads; median
  double samples = 0;    ///< a step
  double flop = 0;       ///< of the networks, as executed
  double peak = 0;  ///< measured floating-point operations per second of this precision and thread count; 0: unknown
  std::int64_t allocated = 0;  ///< most bytes of operator new in a call of steps after the first step
  double rate() const { return samples / seconds.median; }
  double flops() const { return flop / seconds.median; }
};

/// A measured training step of the peer's.
struct PeerRow {
  std::string net, mode;
  std::int64_t rays = 0;
  Spread seconds;
  double processor = 0;  ///< as above
  double samples = 0;    ///< a step
  double rate() const { return samples / seconds.median; }
};

struct BenchStepResults {
  int threads = 0;
  double peak_fp32_one = 0, peak_fp32 = 0;  ///< operations per second on 1 and on `threads` threads
  double peak_bf16_one = 0, peak_bf16 = 0;  ///< 0: the processor has no such instruction
  std::vector<StepRow> steps;               ///< whole steps, alternating with the peers
  std::vector<StepRow> classes;             ///< the same networks over C; C = 0: without semantics
  std::vector<StepRow> scaling;             ///< 1 thread, 2, and `many_threads`
  int many_threads = 0;                     ///< 0: the machine has fewer than 8 cores
  std::vector<PeerRow> peers;
  std::string peer_about, peer_missing;  ///< what answered, or why nothing did
};

/// Goals by name, in the order of the last line; nullopt: not measured here.
using Goals = std::vector<std::pair<std::string, std::optional<double>>>;

constexpr int kPaperClasses = 29;
const std::vector<int> kClassCounts{13, 29, 101, 512, 0};

/// Sizes of one kind of run. `full` is what the presets say; `tiny` ends in seconds.
struct Sizes {
  std::int64_t rays = 1024, sweep_rays = 256;
  int coarse = 64, fine = 128;
  std::vector<std::string> narrow;  ///< overrides of the paper's network
  int hash_samples = 30, hash_steps = 20;
  double probe_s = 0.05;
};

Sizes sizes_of(const std::string& name) {
  Sizes s;
  if (name == "full") return s;
  if (name != "tiny") throw Error(ErrorKind::usage, "usage.value.choice", "--size " + name + ": expected full or tiny");
  s.rays = s.sweep_rays = 32;
  s.coarse = 8;
  s.fine = 8;
  s.narrow = {"semantics.hidden_width=16", "passes.0.field.width=32", "passes.0.field.view_width=16"};
  s.hash_samples = 8;
  s.hash_steps = 2;
  s.probe_s = 0.002;
  return s;
}

/// A network at one setting: its step, and what a step of it costs.
class Case {
 public:
  Case(StepRow row, const StepCaseOptions& options, int steps, AppContext& context)
      : context_(context), step_(options, context.registry), row_(std::move(row)), steps_(steps) {
    row_.classes = options.classes;
    row_.rays = options.rays;
    row_.samples = static_cast<double>(step_.samples_per_step());
    row_.flop = total_flop(step_.work());
    processor_.reserve(1024);        // not while allocations are counted
    step_.seconds(row_.threads, 1);  // memory grows in the first step alone
  }
  double seconds() {
    StepCase::start_threads(row_.threads);  // a team of another size would count as the step's memory and time
    const std::int64_t before = allocations_so_far().bytes;
    const std::clock_t begin = std::clock();
    const double s = step_.seconds(row_.threads, steps_);
    processor_.push_back(static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC / steps_);
    row_.allocated = std::max(row_.allocated, allocations_so_far().bytes - before);
    return s;
  }
  void warm_up() {
    seconds();
    processor_.clear();
  }
  StepRow finished(const Spread& spread, double peak) {
    row_.seconds = spread;
    row_.processor = spread_of(processor_).median;
    row_.peak = peak;
    return row_;
  }
  const StepRow& row() const { return row_; }

 private:
  AppContext& context_;
  StepCase step_;
  StepRow row_;
  int steps_;
  std::vector<double> processor_;
};

class StepBench {
 public:
  StepBench(const BenchStepOptions& options, AppContext& context)
      : options_(options), context_(context), sizes_(sizes_of(options.size)) {
    results_.threads = options.threads > 0 ? options.threads : hardware_threads();
  }

  BenchStepResults run() {
    probe();
    if (options_.peers) start_peer();
    whole_steps();
    class_counts();
    scaling();
    return std::move(results_);
  }

 private:
  std::unique_ptr<Case> paper(const std::string& precision, int threads, std::int64_t rays, int classes) {
    const Sizes& s = sizes_;
    StepCaseOptions o;
    o.config = shared_file("configs/paper.yaml");
    o.classes = classes;
    o.rays = rays;
    o.set = {fmt::format("passes.0.sampler.samples={}", s.coarse), fmt::format("passes.1.sampler.samples={}", s.fine)};
    o.set.insert(o.set.end(), s.narrow.begin(), s.narrow.end());
    add_settings(precision, o);
    return std::make_unique<Case>(new_row("paper", precision, threads), o, 1, context_);
  }

  std::unique_ptr<Case> hash(const std::string& precision, int threads, int log2_entries, int classes) {
    const Sizes& s = sizes_;
    StepCaseOptions o;
    o.config = shared_file("configs/bench/hash_step.yaml");
    o.classes = classes;
    o.rays = s.rays;
    o.set = {fmt::format("passes.0.sampler.samples={}", s.hash_samples),
             fmt::format("passes.0.position.log2_entries={}", log2_entries)};
    add_settings(precision, o);
    return std::make_unique<Case>(new_row(fmt::format("hash T=2^{}", log2_entries), precision, threads), o,
                                  s.hash_steps, context_);
  }

  static StepRow new_row(std::string net, std::string precision, int threads) {
    StepRow row;
    row.net = std::move(net);
    row.precision = std::move(precision);
    row.threads = threads;
    return row;
  }

  void add_settings(const std::string& precision, StepCaseOptions& o) const {
    o.set.push_back("runtime.device=cpu");
    o.set.push_back("runtime.precision=" + precision);
    o.set.insert(o.set.end(), options_.set.begin(), options_.set.end());
  }

  void probe() {
    print_note(context_, "measuring the machine");
    // The best of a few: whatever disturbs a probe only lowers it.
    const auto best = [&](const auto& measure) { return alternate({[&] { return measure(); }}, 3)[0].max; };
    const double s = sizes_.probe_s;
    const int n = results_.threads;
    results_.peak_fp32_one = best([&] { return peak_fp32_flops(1, s); });
    results_.peak_bf16_one = best([&] { return peak_bf16_flops(1, s); });
    results_.peak_fp32 = best([&] { return peak_fp32_flops(n, s); });
    results_.peak_bf16 = best([&] { return peak_bf16_flops(n, s); });
  }

  void start_peer() {
    try {
      const std::string script =
          options_.peer_script.empty() ? shared_file("studies/peers/semfield_peer.py") : options_.peer_script;
      peer_ = std::make_unique<Peer>(script, options_.python, results_.threads);
      results_.peer_about = peer_->description();
    } catch (const Error& error) {
      results_.peer_missing = error.what();
      print_note(context_, "no peer: " + results_.peer_missing);
    }
  }

  double peak(const StepRow& row) const {
    const bool one = row.threads == 1;
    if (!one && row.threads != results_.threads) return 0;
    if (row.precision == "bf16") return one ? results_.peak_bf16_one : results_.peak_bf16;
    return one ? results_.peak_fp32_one : results_.peak_fp32;
  }

  /// Runs the cases of one group in turn, with whatever else takes part in each round.
  std::vector<StepRow> measure(std::vector<std::unique_ptr<Case>> cases) {
    std::vector<std::function<double()>> turns;
    for (const auto& c : cases) turns.emplace_back([&c] { return c->seconds(); });
    const std::vector<Spread> spreads = alternate(turns, options_.repeats);
    std::vector<StepRow> rows;
    for (std::size_t i = 0; i < cases.size(); ++i)
      rows.push_back(cases[i]->finished(spreads[i], peak(cases[i]->row())));
    return rows;
  }

  /// Ours and the peer's in turn; the peak once per round, so that clocks that drift meet both.
  void whole_steps() {
    struct Turn {
      std::unique_ptr<Case> ours;
      std::optional<PeerRequest> peer;
      std::vector<double> processor;  // of the peer
    };
    std::vector<Turn> turns;
    const int n = results_.threads;
    for (const std::string& precision : precisions_) {
      turns.push_back({paper(precision, n, sizes_.rays, kPaperClasses),
                       PeerRequest{"paper", precision, sizes_.rays, kPaperClasses, 0, 1},
                       {}});
    }
    for (const std::string& precision : precisions_) {
      for (const int log2 : {15, 17}) {
        turns.push_back({hash(precision, n, log2, kPaperClasses), std::nullopt, {}});
        if (precision == "fp32")
          turns.back().peer = PeerRequest{"hash", precision, sizes_.rays, kPaperClasses, log2, 1};
      }
    }
    std::vector<std::function<double()>> calls;
    for (Turn& turn : turns) {
      print_note(context_, "warming up: " + turn.ours->row().net + " " + turn.ours->row().precision);
      turn.ours->warm_up();
      calls.emplace_back([&turn] { return turn.ours->seconds(); });
      if (!peer_ || !turn.peer) continue;
      try {
        peer_->measure(*turn.peer);
        calls.emplace_back([this, &turn] {
          const PeerTimes times = peer_->measure(*turn.peer);
          turn.processor.push_back(times.processor);
          return times.seconds;
        });
      } catch (const Error& error) {
        results_.peer_missing += fmt::format("{} {}: {}; ", turn.peer->net, turn.peer->mode, error.what());
        turn.peer.reset();
      }
    }
    calls.emplace_back([&] { return peak_fp32_flops(n, sizes_.probe_s); });
    calls.emplace_back([&] { return peak_bf16_flops(n, sizes_.probe_s); });
    print_note(context_, fmt::format("{} rounds of {} measurements", options_.repeats, calls.size()));
    const std::vector<Spread> spreads = alternate(calls, options_.repeats);
    results_.peak_fp32 = std::max(results_.peak_fp32, spreads[spreads.size() - 2].max);
    results_.peak_bf16 = std::max(results_.peak_bf16, spreads.back().max);
    auto spread = spreads.begin();
    for (Turn& turn : turns) {
      results_.steps.push_back(turn.ours->finished(*spread++, peak(turn.ours->row())));
      if (peer_ && turn.peer) add_peer_row(*turn.peer, *spread++, spread_of(turn.processor).median);
    }
    peer_.reset();
  }

  void add_peer_row(const PeerRequest& r, const Spread& seconds, double processor) {
    const double samples = static_cast<double>(r.rays) * (r.net == "paper" ? 256 : 30);
    const std::string net = r.net == "hash" ? fmt::format("hash T=2^{}", r.log2_entries) : r.net;
    results_.peers.push_back({net, r.mode, r.rays, seconds, processor, samples});
  }

  void class_counts() {
    print_note(context_, "steps over the number of classes");
    std::vector<std::unique_ptr<Case>> deep, small;
    for (const int classes : kClassCounts) {
      deep.push_back(paper("fp32", results_.threads, sizes_.sweep_rays, classes));
      small.push_back(hash("fp32", results_.threads, 15, classes));
    }
    results_.classes = measure(std::move(deep));
    for (StepRow& row : measure(std::move(small))) results_.classes.push_back(std::move(row));
  }

  void scaling() {
    if (hardware_threads() < 2) return;
    constexpr int kMany = 16, kFewest = 8;
    if (hardware_threads() >= kFewest) results_.many_threads = std::min(kMany, hardware_threads());
    print_note(context_,
               "one thread against two" +
                   (results_.many_threads > 0 ? fmt::format(" and {}", results_.many_threads) : std::string()));
    std::vector<int> counts{1, 2};
    if (results_.many_threads > 0) counts.push_back(results_.many_threads);
    std::vector<std::unique_ptr<Case>> cases;
    for (const int threads : counts) cases.push_back(paper("fp32", threads, sizes_.rays, kPaperClasses));
    for (const int threads : counts) cases.push_back(hash("fp32", threads, 15, kPaperClasses));
    results_.scaling = measure(std::move(cases));
  }

  BenchStepOptions options_;
  AppContext& context_;
  Sizes sizes_;
  const std::vector<std::string> precisions_{"fp32", "bf16"};
  std::unique_ptr<Peer> peer_;
  BenchStepResults results_;
};

const StepRow* find_step(const std::vector<StepRow>& rows, const std::string& net, const std::string& precision,
                         int classes, int threads) {
  const auto found = std::find_if(rows.begin(), rows.end(), [&](const StepRow& row) {
    return row.net == net && row.precision == precision && row.classes == classes && row.threads == threads;
  });
  return found == rows.end() ? nullptr : &*found;
}

const PeerRow* find_peer(const BenchStepResults& r, const std::string& net, const std::string& mode) {
  const auto found = std::find_if(r.peers.begin(), r.peers.end(),
                                  [&](const PeerRow& row) { return row.net == net && row.mode == mode; });
  return found == r.peers.end() ? nullptr : &*found;
}

Goals goals_of(const BenchStepResults& r) {
  const auto time = [](const auto& row) { return row.seconds.median; };
  const auto ratio = [&](const auto* over, const auto* under) -> std::optional<double> {
    if (over == nullptr || under == nullptr) return std::nullopt;
    return time(*over) / time(*under);
  };
  const int n = r.threads;
  const auto step = [&](const char* net, const char* precision) {
    return find_step(r.steps, net, precision, kPaperClasses, n);
  };
  const auto of_classes = [&](const char* net, int classes) { return find_step(r.classes, net, "fp32", classes, n); };
  // How many times the peer's rate ours is: the same as the ratio of times, in the sizes where both do the same work.
  const auto faster = [&](const char* net, const char* mode) -> std::optional<double> {
    const StepRow* ours = step(net, mode);
    const PeerRow* theirs = find_peer(r, net, mode);
    if (ours == nullptr || theirs == nullptr) return std::nullopt;
    return (ours->samples / time(*ours)) / (theirs->samples / time(*theirs));
  };
  const StepRow* paper = step("paper", "fp32");
  // The worse of the two networks.
  const std::optional<double> p7 = std::max(ratio(of_classes("paper", 512), of_classes("paper", 13)),
                                            ratio(of_classes("hash T=2^15", 512), of_classes("hash T=2^15", 13)));
  return {{"P1", faster("paper", "fp32")},
          {"P2", faster("paper", "bf16")},
          {"P2c", ratio(step("hash T=2^15", "fp32"), step("hash T=2^15", "bf16"))},
          {"P3", faster("hash T=2^15", "fp32")},
          {"P4", paper != nullptr && paper->peak > 0 ? std::optional(paper->flops() / paper->peak) : std::nullopt},
          {"P7", p7},
          {"P8", ratio(of_classes("paper", 101), of_classes("paper", 0))},
          {"threads2", ratio(find_step(r.scaling, "paper", "fp32", kPaperClasses, 1),
                             find_step(r.scaling, "paper", "fp32", kPaperClasses, 2))},
          {"P15", r.many_threads == 0 ? std::nullopt
                                      : ratio(find_step(r.scaling, "paper", "fp32", kPaperClasses, 1),
                                              find_step(r.scaling, "paper", "fp32", kPaperClasses, r.many_threads))}};
}

std::string ratio_text(const std::optional<double>& value) {
  if (!value) return "n/a";
  return *value >= 9.995 ? fmt::format("{:.1f}", *value) : fmt::format("{:.2f}", *value);
}

void print_rows(const char* title, const std::vector<StepRow>& rows) {
  if (rows.empty()) return;
  std::printf("\n%s\n%-12s %-5s %7s %7s %6s  %10s  %-21s %9s %12s %9s %8s %10s\n", title, "net", "", "threads",
              "classes", "rays", "s per step", "(min .. max)", "core s", "samples/s", "GFLOP/s", "of peak",
              "allocated");
  for (const StepRow& row : rows) {
    const std::string classes = row.classes == 0 ? "none" : std::to_string(row.classes);
    const std::string range = fmt::format("({:.4f} .. {:.4f})", row.seconds.min, row.seconds.max);
    const std::string share = row.peak > 0 ? fmt::format("{:.2f}", row.flops() / row.peak) : "-";
    std::printf("%-12s %-5s %7d %7s %6lld  %10.4f  %-21s %9.4f %12.0f %9.1f %8s %10lld\n", row.net.c_str(),
                row.precision.c_str(), row.threads, classes.c_str(), static_cast<long long>(row.rays),
                row.seconds.median, range.c_str(), row.processor, row.rate(), row.flops() * 1e-9, share.c_str(),
                static_cast<long long>(row.allocated));
  }
}

void print_peers(const BenchStepResults& results) {
  if (!results.peer_about.empty()) std::printf("\npeer: %s\n", results.peer_about.c_str());
  for (const PeerRow& row : results.peers) {
    std::printf("%-12s %-5s %6lld rays  %10.4f  (%.4f .. %.4f) %9.4f core s %12.0f samples/s\n", row.net.c_str(),
                row.mode.c_str(), static_cast<long long>(row.rays), row.seconds.median, row.seconds.min,
                row.seconds.max, row.processor, row.rate());
  }
  for (const StepRow& ours : results.steps) {
    for (const PeerRow& row : results.peers) {
      if (row.net == ours.net && row.mode == ours.precision) {
        std::printf("ours / peer's rate, %s %s: %.2f\n", row.net.c_str(), row.mode.c_str(), ours.rate() / row.rate());
      }
    }
  }
  if (!results.peer_missing.empty()) std::printf("not measured: %s\n", results.peer_missing.c_str());
}

void print_table(const BenchStepOptions& options, const BenchStepResults& r) {
  const Environment e = this_environment();
  std::printf("machine    %s, %d cores; %d threads; %s, %s\n", e.cpu.c_str(), e.hardware_threads, r.threads,
              e.compiler.c_str(), e.build_type.c_str());
  std::printf("multiply-adds from registers, GFLOP/s on 1 and %d threads: fp32 %.1f, %.1f; bf16 %.1f, %.1f\n",
              r.threads, r.peak_fp32_one * 1e-9, r.peak_fp32 * 1e-9, r.peak_bf16_one * 1e-9, r.peak_bf16 * 1e-9);
  std::printf("matrix products: %s\n", std::string(isa_name(isa())).c_str());
  std::printf("medians of %d rounds, every measurement once per round; networks and rays: %s\n", options.repeats,
              options.size.c_str());
  std::printf(
      "GFLOP/s count the multiply-adds of the networks that are executed (exact savings taken off), not those of "
      "encodings, sampling, compositing and Adam\n");
  print_rows("whole steps", r.steps);
  print_rows("over the number of classes (fewer rays per step for the paper's network)", r.classes);
  print_rows("threads", r.scaling);
  print_peers(r);
}

Json spread_json(const Spread& s) { return {{"median", s.median}, {"min", s.min}, {"max", s.max}}; }

Json rows_json(const std::vector<StepRow>& rows) {
  Json all = Json::array();
  for (const StepRow& row : rows) {
    all.push_back({{"net", row.net},
                   {"precision", row.precision},
                   {"threads", row.threads},
                   {"classes", row.classes},
                   {"rays", row.rays},
                   {"seconds", spread_json(row.seconds)},
                   {"processor_s", row.processor},
                   {"samples_per_s", row.rate()},
                   {"flop", row.flop},
                   {"flops", row.flops()},
                   {"peak_share", row.peak > 0 ? Json(row.flops() / row.peak) : Json(nullptr)},
                   {"allocated_bytes", row.allocated}});
  }
  return all;
}

Json results_json(const BenchStepOptions& options, const BenchStepResults& r) {
  Json out = Json::parse(environment_json(this_environment()));
  out["threads"] = r.threads;
  out["repeats"] = options.repeats;
  out["size"] = options.size;
  out["isa"] = std::string(isa_name(isa()));
  out["peak_fp32_flops"] = {r.peak_fp32_one, r.peak_fp32};
  out["peak_bf16_flops"] = {r.peak_bf16_one, r.peak_bf16};
  out["steps"] = rows_json(r.steps);
  out["classes"] = rows_json(r.classes);
  out["scaling"] = rows_json(r.scaling);
  out["peers"] = Json::array();
  for (const PeerRow& row : r.peers) {
    out["peers"].push_back({{"net", row.net},
                            {"mode", row.mode},
                            {"rays", row.rays},
                            {"seconds", spread_json(row.seconds)},
                            {"processor_s", row.processor},
                            {"samples_per_s", row.rate()}});
  }
  out["peer"] = r.peer_about;
  out["not_measured"] = r.peer_missing;
  for (const auto& [name, value] : goals_of(r)) out["goals"][name] = value ? Json(*value) : Json(nullptr);
  return out;
}

int bench_step(const BenchStepOptions& options, AppContext& context) {
  if (options.repeats < 1) throw Error(ErrorKind::usage, "usage.value.range", "--repeats: expected at least 1");
  const BenchStepResults results = StepBench(options, context).run();
  if (context.json) {
    print_json(context, results_json(options, results));
    return 0;
  }
  print_table(options, results);
  std::string line = "bench:";
  for (const auto& [name, value] : goals_of(results)) line += " " + name + "=" + ratio_text(value);
  std::printf("\n%s isa=%s\n", line.c_str(), std::string(isa_name(isa())).c_str());
  return 0;
}

}  // namespace
}  // namespace semfield::app

// By name, as the program finds them in the library: each measures, prints, and returns the exit code.
extern "C" int semfield_bench_gpu(const semfield::app::BenchGpuOptions& options, semfield::app::AppContext& context);
int semfield_bench_gpu(const semfield::app::BenchGpuOptions& options, semfield::app::AppContext& context) {
  return semfield::app::bench_gpu(options, context);
}
extern "C" int semfield_bench_step(const semfield::app::BenchStepOptions& options, semfield::app::AppContext& context);
int semfield_bench_step(const semfield::app::BenchStepOptions& options, semfield::app::AppContext& context) {
  return semfield::app::bench_step(options, context);
}
