// bench: training steps and frames timed in turn, next to the same steps in PyTorch, as a table or JSON.
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

/// A measured training step or frame, ours or the peer's.
struct Row {
  std::string net;        ///< paper, hash T=2^15, ...; in `bench gpu` the measurement's whole name
  std::string precision;  ///< fp32, bf16; the peer's mode
  int threads = 0, classes = 0;
  std::int64_t rays = 0;
  Spread seconds = {};
  double processor = 0;  ///< processor seconds per step, summed over threads; median
  double samples = 0;    ///< a step
  double flop = 0;       ///< of the networks, as executed
  double peak = 0;  ///< measured floating-point operations per second of this precision and thread count; 0: unknown
  std::int64_t allocated = 0;  ///< most bytes of operator new in a call of steps after the first step
  double rate() const { return samples / seconds.median; }
  double flops() const { return flop / seconds.median; }
};

/// The row of this name; of those of `bench step` with these numbers too. Null: not measured.
const Row* find_row(const std::vector<Row>& rows, const std::string& net, const std::string& precision = "",
                    int classes = 0, int threads = 0) {
  const auto found = std::find_if(rows.begin(), rows.end(), [&](const Row& row) {
    return row.net == net && row.precision == precision && row.classes == classes && row.threads == threads;
  });
  return found == rows.end() ? nullptr : &*found;
}

std::optional<double> ratio(const Row* over, const Row* under) {
  if (over == nullptr || under == nullptr) return std::nullopt;
  return over->seconds.median / under->seconds.median;
}

/// Goals by name, in the order of the last line; nullopt: not measured here.
using Goals = std::vector<std::pair<std::string, std::optional<double>>>;

/// What takes its turn in every round: steps or a frame of ours, or a step of the peer's.
struct Turn {
  Row row;
  std::shared_ptr<StepCase> ours = {};
  int steps = 1;
  std::int64_t frame_rays = 0;  ///< of a frame, which is then rendered instead
  std::optional<PeerRequest> peer = {};
  std::vector<double> processor = {};
};

class Bench {
 public:
  Bench(const BenchOptions& options, AppContext& context) : context_(context), options_(options) {}

 protected:
  /// Throws Error(unavailable) without a Python that has torch.
  void start_peer(const std::string& script, int threads, const char* device) {
    peer_ = std::make_unique<Peer>(script.empty() ? shared_file("studies/peers/semfield_peer.py") : script,
                                   options_.python, threads, device);
    peer_about_ = peer_->description();
  }

  /// A turn of ours, after `warm_up` steps: memory grows in the first of them alone.
  Turn turn_of(Row row, const StepCaseOptions& options, int steps, int warm_up) const {
    Turn turn{std::move(row), std::make_shared<StepCase>(options, context_.registry), steps};
    turn.row.samples = static_cast<double>(turn.ours->samples_per_step());
    turn.row.flop = total_flop(turn.ours->work());
    if (warm_up > 0) turn.ours->seconds(turn.row.threads, warm_up);
    return turn;
  }

  double take(Turn& turn) const {
    if (turn.peer) {
      const PeerTimes times = peer_->measure(*turn.peer);
      turn.processor.push_back(times.processor);
      return times.seconds;
    }
    if (turn.frame_rays > 0) return turn.ours->render_seconds(turn.frame_rays);
    StepCase::start_threads(turn.row.threads);  // a team of another size would count as the step's memory and time
    const std::int64_t before = allocations_so_far().bytes;
    const std::clock_t begin = std::clock();
    const double seconds = turn.ours->seconds(turn.row.threads, turn.steps);
    const std::clock_t end = std::clock();
    turn.row.allocated = std::max(turn.row.allocated, allocations_so_far().bytes - before);
    turn.processor.push_back(static_cast<double>(end - begin) / CLOCKS_PER_SEC / turn.steps);
    return seconds;
  }

  /// Every turn once a round, and `more` with them.
  std::vector<Row> measure(std::vector<Turn> turns, const std::vector<std::function<double()>>& more = {}) const {
    std::vector<std::function<double()>> calls;
    for (Turn& turn : turns) calls.emplace_back([this, &turn] { return take(turn); });
    calls.insert(calls.end(), more.begin(), more.end());
    const std::vector<Spread> spreads = alternate(calls, options_.repeats);
    std::vector<Row> rows;
    for (std::size_t i = 0; i < turns.size(); ++i) {
      rows.push_back(turns[i].row);
      rows.back().seconds = spreads[i];
      if (!turns[i].processor.empty()) rows.back().processor = spread_of(turns[i].processor).median;
    }
    return rows;
  }
  void say_rounds(std::size_t count) const {
    print_note(context_, fmt::format("{} rounds of {} measurements", options_.repeats, count));
  }

  AppContext& context_;
  std::unique_ptr<Peer> peer_;
  std::string peer_about_;  ///< what answered

 private:
  const BenchOptions& options_;
};

// bench gpu: training steps and frames on a GPU.

constexpr std::int64_t kFrameRays = 320 * 240;
constexpr double kLimit_ms =
    1.09;  // of the paper step's multiply-adds in bf16 at 790 TFLOP/s, a good product on an H200

struct GpuCase {
  const char *net, *precision;
  int classes, steps;
  bool deterministic = false;
};

// Steps of the hash grid have 8192 rays of 32 samples: 2^18.
constexpr GpuCase kGpuCases[] = {
    {"paper", "bf16", 29, 64},  {"paper", "bf16", 29, 64, true}, {"paper", "bf16", 13, 64},
    {"paper", "bf16", 512, 64}, {"paper", "bf16", 101, 64},      {"paper", "bf16", 0, 64},
    {"paper", "fp32", 29, 8},   {"hash", "bf16", 29, 128},       {"hash", "bf16", 13, 128},
    {"hash", "bf16", 512, 128}, {"hash", "bf16", 29, 128, true}, {"hash", "fp32", 29, 128}};

StepCaseOptions options_of(const GpuCase& c) {
  StepCaseOptions o;
  const bool hash = c.net == std::string_view("hash");
  o.config = shared_file(hash ? "configs/bench/hash_step.yaml" : "configs/paper.yaml");
  o.set = {"runtime.device=cuda"};
  if (c.precision == std::string_view("bf16")) o.set.emplace_back("runtime.precision=bf16");
  if (c.deterministic) o.set.emplace_back("runtime.deterministic=true");
  o.classes = c.classes;
  if (!hash) return o;
  o.set.insert(o.set.end(), {"passes.0.sampler.samples=32", "passes.0.position.log2_entries=19",
                             "passes.0.position.finest_resolution=2048"});
  o.rays = 8192;
  return o;
}

/// What cannot be measured is a note. Throws Error(unavailable) without a device.
class GpuBench final : public Bench {
 public:
  GpuBench(const BenchGpuOptions& options, AppContext& context) : Bench(options, context), options_(options) {}

  int run() {
    const std::string about = cuda_library().describe(0);
    print_note(context_, about);
    for (const GpuCase& c : kGpuCases) {
      const std::string name =
          fmt::format("{} {} C={}{}", c.net, c.precision, c.classes, c.deterministic ? " deterministic" : "");
      add(name, [&] {
        print_note(context_, "warming up: " + name);
        // Sizes arenas, chooses algorithms, captures the graph.
        turns_.push_back(turn_of({name, "", hardware_threads()}, options_of(c), c.steps, 5));
      });
    }
    add("frame 320x240 bf16", [&] {
      Turn frame = turn_of({"frame 320x240 bf16", "", hardware_threads()}, options_of(kGpuCases[0]), 1, 0);
      frame.frame_rays = kFrameRays;
      take(frame);
      turns_.push_back(std::move(frame));
    });
    if (options_.peers) add_peers();
    say_rounds(turns_.size());
    const std::vector<Row> rows = measure(std::move(turns_));
    print(about, rows, goals_of(rows));
    return 0;
  }

 private:
  template <class Make>
  void add(const std::string& name, const Make& make) {
    if (!name.starts_with(options_.only)) return;
    not_measured_if(name, make);
  }
  template <class Make>
  void not_measured_if(const std::string& name, const Make& make) {
    try {
      make();
    } catch (const Error& error) {
      print_note(context_, "not measured: " + name + ": " + error.what());
    }
  }

  void add_peers() {
    try {
      start_peer("", hardware_threads(), "cuda");
    } catch (const Error& error) {
      return print_note(context_, std::string("no peer: ") + error.what());
    }
    for (const char* mode : {"fp32", "tf32", "bf16", "bf16_compile"}) {
      const std::string name = std::string("torch paper ") + mode;
      not_measured_if(name, [&] {
        print_note(context_, "warming up: " + name);
        peer_->measure({"paper", mode, 1024, 29, 0, 5});
        Turn turn{{name, "", hardware_threads()}};
        turn.peer = {"paper", mode, 1024, 29, 0, 10};
        turns_.push_back(std::move(turn));
      });
    }
  }

  static std::vector<std::pair<std::string, std::string>> goals_of(const std::vector<Row>& rows) {
    const auto text = [](const std::optional<double>& value, int digits) {
      return value ? fmt::format("{:.{}f}", *value, digits) : "n/a";
    };
    const auto ms = [&](const char* name) {
      const Row* row = find(rows, name);
      return row != nullptr ? std::optional(1e3 * row->seconds.median) : std::nullopt;
    };
    const auto over = [&](const char* a, const char* b) { return ratio(find(rows, a), find(rows, b)); };
    std::optional<double> peer;  // of its fastest mode
    for (const Row& row : rows) {
      if (row.net.starts_with("torch paper") && (!peer || 1e3 * row.seconds.median < *peer))
        peer = 1e3 * row.seconds.median;
    }
    const std::optional<double> step = ms("paper bf16 C=29"), frame = ms("frame 320x240 bf16");
    return {{"step_ms", text(step, 3)},
            {"torch_best_ms", text(peer, 2)},
            {"P5", text(step && peer ? std::optional(*peer / *step) : std::nullopt, 2)},
            {"P6", text(step ? std::optional(*step / kLimit_ms) : std::nullopt, 2)},
            {"P7",
             text(std::max(over("paper bf16 C=512", "paper bf16 C=13"), over("hash bf16 C=512", "hash bf16 C=13")), 3)},
            {"P8", text(over("paper bf16 C=101", "paper bf16 C=0"), 3)},
            {"P11", text(std::max(over("paper bf16 C=29 deterministic", "paper bf16 C=29"),
                                  over("hash bf16 C=29 deterministic", "hash bf16 C=29")),
                         3)},
            {"frame_fps", text(frame ? std::optional(1e3 / *frame) : std::nullopt, 1)},
            {"hash_ms", text(ms("hash bf16 C=29"), 3)}};
  }
  static const Row* find(const std::vector<Row>& rows, const char* name) {
    return find_row(rows, name, "", 0, hardware_threads());
  }

  void print(const std::string& about, const std::vector<Row>& rows,
             const std::vector<std::pair<std::string, std::string>>& goals) const {
    if (context_.json) {
      Json out{{"device", about}, {"peer", peer_about_}};
      for (const Row& row : rows)
        out["ms"][row.net] = {1e3 * row.seconds.median, 1e3 * row.seconds.min, 1e3 * row.seconds.max};
      for (const auto& [name, value] : goals) out["goals"][name] = value;
      return print_json(context_, out);
    }
    std::printf("device     %s\n", about.c_str());
    if (!peer_about_.empty()) std::printf("peer       %s\n", peer_about_.c_str());
    std::printf("medians of %d rounds, every measurement once per round\n%-32s %10s  %s\n", options_.repeats, "", "ms",
                "(min .. max)");
    for (const Row& row : rows) {
      std::printf("%-32s %10.3f  (%.3f .. %.3f)\n", row.net.c_str(), 1e3 * row.seconds.median, 1e3 * row.seconds.min,
                  1e3 * row.seconds.max);
    }
    std::string line = "bench gpu:";
    for (const auto& [name, value] : goals) line += " " + name + "=" + value;
    std::printf("%s\n", line.c_str());
  }

  const BenchGpuOptions& options_;
  std::vector<Turn> turns_;
};

// bench step: whole training steps, the machine's limits and the peer.

struct BenchStepResults {
  int threads = 0;
  double peak_fp32_one = 0, peak_fp32 = 0;  ///< operations per second on 1 and on `threads` threads
  double peak_bf16_one = 0, peak_bf16 = 0;  ///< 0: the processor has no such instruction
  std::vector<Row> steps;                   ///< whole steps, alternating with the peers
  std::vector<Row> classes;                 ///< the same networks over C; C = 0: without semantics
  std::vector<Row> scaling;                 ///< 1 thread, 2, and `many_threads`
  int many_threads = 0;                     ///< 0: the machine has fewer than 8 cores
  std::vector<Row> peers;
  std::string peer_about, peer_missing;  ///< what answered, or why nothing did
};

constexpr int kPaperClasses = 29;
constexpr int kClassCounts[] = {13, 29, 101, 512, 0};

/// Sizes of one kind of run. `full` is what the presets say; `tiny` ends in seconds.
struct Sizes {
  std::int64_t rays = 1024, sweep_rays = 256;
  int coarse = 64, fine = 128;
  std::vector<std::string> narrow = {};  ///< overrides of the paper's network
  int hash_samples = 30, hash_steps = 20;
  double probe_s = 0.05;
};
const Sizes kTiny{
    32, 32, 8,    8, {"semantics.hidden_width=16", "passes.0.field.width=32", "passes.0.field.view_width=16"},
    8,  2,  0.002};

class StepBench final : public Bench {
 public:
  StepBench(const BenchStepOptions& options, AppContext& context)
      : Bench(options, context), options_(options), sizes_(options.size == "tiny" ? kTiny : Sizes()) {
    results_.threads = options.threads > 0 ? options.threads : hardware_threads();
  }

  BenchStepResults run() {
    probe();
    if (options_.peers) {
      try {
        start_peer(options_.peer_script, results_.threads, "cpu");
      } catch (const Error& error) {
        results_.peer_missing = error.what();
        print_note(context_, "no peer: " + results_.peer_missing);
      }
      results_.peer_about = peer_about_;
    }
    whole_steps();
    class_counts();
    scaling();
    return std::move(results_);
  }

 private:
  Turn paper(const std::string& precision, int threads, std::int64_t rays, int classes) const {
    const Sizes& s = sizes_;
    StepCaseOptions o;
    o.config = shared_file("configs/paper.yaml");
    o.rays = rays;
    o.set = {fmt::format("passes.0.sampler.samples={}", s.coarse), fmt::format("passes.1.sampler.samples={}", s.fine)};
    o.set.insert(o.set.end(), s.narrow.begin(), s.narrow.end());
    return made("paper", precision, threads, classes, std::move(o), 1);
  }
  Turn hash(const std::string& precision, int threads, int log2_entries, int classes) const {
    StepCaseOptions o;
    o.config = shared_file("configs/bench/hash_step.yaml");
    o.rays = sizes_.rays;
    o.set = {fmt::format("passes.0.sampler.samples={}", sizes_.hash_samples),
             fmt::format("passes.0.position.log2_entries={}", log2_entries)};
    return made(fmt::format("hash T=2^{}", log2_entries), precision, threads, classes, std::move(o), sizes_.hash_steps);
  }
  Turn made(std::string net, const std::string& precision, int threads, int classes, StepCaseOptions o,
            int steps) const {
    o.classes = classes;
    o.set.insert(o.set.end(), {"runtime.device=cpu", "runtime.precision=" + precision});
    o.set.insert(o.set.end(), options_.set.begin(), options_.set.end());
    return turn_of({std::move(net), precision, threads, classes, o.rays}, o, steps, 1);
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

  std::vector<Row> with_peaks(std::vector<Row> rows) const {
    const BenchStepResults& r = results_;
    for (Row& row : rows) {
      const bool one = row.threads == 1, bf16 = row.precision == "bf16";
      if (one || row.threads == r.threads)
        row.peak = bf16 ? (one ? r.peak_bf16_one : r.peak_bf16) : (one ? r.peak_fp32_one : r.peak_fp32);
    }
    return rows;
  }

  /// Ours and the peer's in turn; the peak once per round, so that clocks that drift meet both.
  void whole_steps() {
    std::vector<Turn> turns;
    const int n = results_.threads;
    for (const std::string precision : {"fp32", "bf16"})
      add_with_peer(turns, paper(precision, n, sizes_.rays, kPaperClasses),
                    PeerRequest{"paper", precision, sizes_.rays, kPaperClasses, 0, 1}, 256);
    for (const std::string precision : {"fp32", "bf16"}) {
      for (const int log2 : {15, 17}) {
        std::optional<PeerRequest> peer;
        if (precision == "fp32") peer = PeerRequest{"hash", precision, sizes_.rays, kPaperClasses, log2, 1};
        add_with_peer(turns, hash(precision, n, log2, kPaperClasses), peer, 30);
      }
    }
    say_rounds(turns.size() + 2);
    const auto seen = [](double& peak, double flops) { return peak = std::max(peak, flops), flops; };
    const std::vector<Row> rows =
        measure(std::move(turns), {[&] { return seen(results_.peak_fp32, peak_fp32_flops(n, sizes_.probe_s)); },
                                   [&] { return seen(results_.peak_bf16, peak_bf16_flops(n, sizes_.probe_s)); }});
    for (const Row& row : with_peaks(rows)) (row.threads == 0 ? results_.peers : results_.steps).push_back(row);
    peer_.reset();
  }

  void add_with_peer(std::vector<Turn>& turns, Turn ours, const std::optional<PeerRequest>& peer, int samples_of_ray) {
    print_note(context_, "warming up: " + ours.row.net + " " + ours.row.precision);
    take(ours);
    ours.processor.clear();
    const Row& row = turns.emplace_back(std::move(ours)).row;
    if (!peer_ || !peer) return;
    Turn theirs{{row.net, peer->mode, 0, 0, peer->rays}};
    theirs.row.samples = static_cast<double>(peer->rays * samples_of_ray);
    theirs.peer = peer;
    try {
      take(theirs);
      theirs.processor.clear();
      turns.push_back(std::move(theirs));
    } catch (const Error& error) {
      results_.peer_missing += fmt::format("{} {}: {}; ", peer->net, peer->mode, error.what());
    }
  }

  void class_counts() {
    print_note(context_, "steps over the number of classes");
    std::vector<Turn> deep, small;
    for (const int classes : kClassCounts) {
      deep.push_back(paper("fp32", results_.threads, sizes_.sweep_rays, classes));
      small.push_back(hash("fp32", results_.threads, 15, classes));
    }
    results_.classes = with_peaks(measure(std::move(deep)));
    for (Row& row : with_peaks(measure(std::move(small)))) results_.classes.push_back(std::move(row));
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
    std::vector<Turn> turns;
    for (const int threads : counts) turns.push_back(paper("fp32", threads, sizes_.rays, kPaperClasses));
    for (const int threads : counts) turns.push_back(hash("fp32", threads, 15, kPaperClasses));
    results_.scaling = with_peaks(measure(std::move(turns)));
  }

  const BenchStepOptions& options_;
  const Sizes sizes_;
  BenchStepResults results_;
};

Goals goals_of(const BenchStepResults& r) {
  const int n = r.threads;
  const auto step = [&](const char* net, const char* precision) {
    return find_row(r.steps, net, precision, kPaperClasses, n);
  };
  const auto of_classes = [&](const char* net, int classes) { return find_row(r.classes, net, "fp32", classes, n); };
  // How many times the peer's rate ours is: the same as the ratio of times, in the sizes where both do the same work.
  const auto faster = [&](const char* net, const char* mode) -> std::optional<double> {
    const Row *ours = step(net, mode), *theirs = find_row(r.peers, net, mode);
    if (ours == nullptr || theirs == nullptr) return std::nullopt;
    return ours->rate() / theirs->rate();
  };
  const Row* paper = step("paper", "fp32");
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
          {"threads2", ratio(find_row(r.scaling, "paper", "fp32", kPaperClasses, 1),
                             find_row(r.scaling, "paper", "fp32", kPaperClasses, 2))},
          {"P15", r.many_threads == 0 ? std::nullopt
                                      : ratio(find_row(r.scaling, "paper", "fp32", kPaperClasses, 1),
                                              find_row(r.scaling, "paper", "fp32", kPaperClasses, r.many_threads))}};
}

std::string ratio_text(const std::optional<double>& value) {
  if (!value) return "n/a";
  return *value >= 9.995 ? fmt::format("{:.1f}", *value) : fmt::format("{:.2f}", *value);
}

void print_rows(const char* title, const std::vector<Row>& rows) {
  if (rows.empty()) return;
  std::printf("\n%s\n%-12s %-5s %7s %7s %6s  %10s  %-21s %9s %12s %9s %8s %10s\n", title, "net", "", "threads",
              "classes", "rays", "s per step", "(min .. max)", "core s", "samples/s", "GFLOP/s", "of peak",
              "allocated");
  for (const Row& row : rows) {
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
  for (const Row& row : results.peers) {
    std::printf("%-12s %-5s %6lld rays  %10.4f  (%.4f .. %.4f) %9.4f core s %12.0f samples/s\n", row.net.c_str(),
                row.precision.c_str(), static_cast<long long>(row.rays), row.seconds.median, row.seconds.min,
                row.seconds.max, row.processor, row.rate());
  }
  for (const Row& ours : results.steps) {
    for (const Row& row : results.peers) {
      if (row.net == ours.net && row.precision == ours.precision) {
        std::printf("ours / peer's rate, %s %s: %.2f\n", row.net.c_str(), row.precision.c_str(),
                    ours.rate() / row.rate());
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

Json rows_json(const std::vector<Row>& rows) {
  Json all = Json::array();
  for (const Row& row : rows) {
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
  for (const Row& row : r.peers) {
    out["peers"].push_back({{"net", row.net},
                            {"mode", row.precision},
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
  return semfield::app::GpuBench(options, context).run();
}
extern "C" int semfield_bench_step(const semfield::app::BenchStepOptions& options, semfield::app::AppContext& context);
int semfield_bench_step(const semfield::app::BenchStepOptions& options, semfield::app::AppContext& context) {
  return semfield::app::bench_step(options, context);
}
