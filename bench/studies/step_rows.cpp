#include "studies/step_rows.h"

#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <functional>
#include <memory>
#include <string_view>

#include "compute/parallel.h"
#include "compute/peak_probe.h"
#include "core/error.h"
#include "studies/peer.h"

namespace semfield {

namespace {

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
  Case(StepRow row, const StepCaseOptions& options, int steps, const StudyTools& tools)
      : tools_(tools), step_(options, tools.registry), row_(std::move(row)), steps_(steps) {
    row_.classes = options.classes;
    row_.rays = options.rays;
    row_.samples = static_cast<double>(step_.samples_per_step());
    row_.flop = total_flop(step_.work());
    processor_.reserve(1024);        // not while allocations are counted
    step_.seconds(row_.threads, 1);  // memory grows in the first step alone
  }
  double seconds() {
    StepCase::start_threads(row_.threads);  // a team of another size would count as the step's memory and time
    const std::int64_t before = tools_.allocated_bytes();
    const std::clock_t begin = std::clock();
    const double s = step_.seconds(row_.threads, steps_);
    processor_.push_back(static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC / steps_);
    row_.allocated = std::max(row_.allocated, tools_.allocated_bytes() - before);
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
  const StudyTools& tools_;
  StepCase step_;
  StepRow row_;
  int steps_;
  std::vector<double> processor_;
};

class StepBench {
 public:
  StepBench(const BenchStepOptions& options, const StudyTools& tools)
      : options_(options), tools_(tools), sizes_(sizes_of(options.size)) {
    results_.threads = options.threads > 0 ? options.threads : hardware_threads();
    if (has_precisions()) precisions_.push_back("bf16");
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
    o.config = tools_.shared_file("configs/paper.yaml");
    o.classes = classes;
    o.rays = rays;
    o.set = {fmt::format("passes.0.sampler.samples={}", s.coarse), fmt::format("passes.1.sampler.samples={}", s.fine)};
    o.set.insert(o.set.end(), s.narrow.begin(), s.narrow.end());
    add_settings(precision, o);
    return std::make_unique<Case>(new_row("paper", precision, threads), o, 1, tools_);
  }

  std::unique_ptr<Case> hash(const std::string& precision, int threads, int log2_entries, int classes) {
    const Sizes& s = sizes_;
    StepCaseOptions o;
    o.config = tools_.shared_file("configs/bench/hash_step.yaml");
    o.classes = classes;
    o.rays = s.rays;
    o.set = {fmt::format("passes.0.sampler.samples={}", s.hash_samples),
             fmt::format("passes.0.position.log2_entries={}", log2_entries)};
    add_settings(precision, o);
    return std::make_unique<Case>(new_row(fmt::format("hash T=2^{}", log2_entries), precision, threads), o,
                                  s.hash_steps, tools_);
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
    tools_.note("measuring the machine");
    // The best of a few: whatever disturbs a probe only lowers it.
    const auto best = [&](const auto& measure) { return alternate({[&] { return measure(); }}, 3)[0].max; };
    const double s = sizes_.probe_s;
    const int n = results_.threads;
    results_.peak_fp32_one = best([&] { return peak_fp32_flops(1, s); });
    results_.peak_bf16_one = best([&] { return peak_bf16_flops(1, s); });
    results_.peak_fp32 = best([&] { return peak_fp32_flops(n, s); });
    results_.peak_bf16 = best([&] { return peak_bf16_flops(n, s); });
    for (const auto& [name, size] :
         {std::pair<const char*, std::size_t>{"32 KB", 32u << 10}, {"4 MB", 4u << 20}, {"64 MB", 64u << 20}}) {
      const std::size_t bytes = size;  // clang 14 cannot capture a structured binding
      results_.reads[name] = {best([&] { return random_reads(1, bytes, s); }),
                              best([&] { return random_reads(n, bytes, s); })};
    }
  }

  void start_peer() {
    try {
      const std::string script =
          options_.peer_script.empty() ? tools_.shared_file("bench/peers/semfield_peer.py") : options_.peer_script;
      peer_ = std::make_unique<Peer>(script, options_.python, results_.threads, true);
      results_.peer_about = peer_->description();
    } catch (const Error& error) {
      results_.peer_missing = error.what();
      tools_.note("no peer: " + results_.peer_missing);
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
      tools_.note("warming up: " + turn.ours->row().net + " " + turn.ours->row().precision);
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
    tools_.note(fmt::format("{} rounds of {} measurements", options_.repeats, calls.size()));
    const std::vector<Spread> spreads = alternate(calls, options_.repeats);
    results_.peak_fp32 = std::max(results_.peak_fp32, spreads[spreads.size() - 2].max);
    results_.peak_bf16 = std::max(results_.peak_bf16, spreads.back().max);
    auto spread = spreads.begin();
    for (Turn& turn : turns) {
      results_.steps.push_back(turn.ours->finished(*spread++, peak(turn.ours->row())));
      if (peer_ && turn.peer) add_peer_row(*turn.peer, true, *spread++, spread_of(turn.processor).median);
    }
    peer_.reset();
    if (!results_.peers.empty()) as_installed();
  }

  void add_peer_row(const PeerRequest& r, bool tuned, const Spread& seconds, double processor) {
    const double samples = static_cast<double>(r.rays) * (r.net == "paper" ? 256 : 30);
    const std::string net = r.net == "hash" ? fmt::format("hash T=2^{}", r.log2_entries) : r.net;
    results_.peers.push_back({net, r.mode, tuned, r.rays, seconds, processor, samples});
  }

  /// The peer without any tuning, once: to show what the tuning is worth.
  void as_installed() {
    tools_.note("the peer as installed");
    try {
      const std::string script =
          options_.peer_script.empty() ? tools_.shared_file("bench/peers/semfield_peer.py") : options_.peer_script;
      Peer peer(script, options_.python, results_.threads, false);
      std::vector<PeerRequest> requests;
      for (const std::string& mode : precisions_) requests.push_back({"paper", mode, sizes_.rays, kPaperClasses, 0, 1});
      requests.push_back({"hash", "fp32", sizes_.rays, kPaperClasses, 15, 1});
      for (const PeerRequest& request : requests) {
        const PeerTimes times = peer.measure(request);
        add_peer_row(request, false, spread_of({times.seconds}), times.processor);
      }
    } catch (const Error& error) {
      results_.peer_missing += fmt::format("as installed: {}; ", error.what());
    }
  }

  void class_counts() {
    tools_.note("steps over the number of classes");
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
    tools_.note("one thread against two" +
                (results_.many_threads > 0 ? fmt::format(" and {}", results_.many_threads) : std::string()));
    std::vector<int> counts{1, 2};
    if (results_.many_threads > 0) counts.push_back(results_.many_threads);
    std::vector<std::unique_ptr<Case>> cases;
    for (const int threads : counts) cases.push_back(paper("fp32", threads, sizes_.rays, kPaperClasses));
    for (const int threads : counts) cases.push_back(hash("fp32", threads, 15, kPaperClasses));
    results_.scaling = measure(std::move(cases));
  }

  BenchStepOptions options_;
  const StudyTools& tools_;
  Sizes sizes_;
  std::vector<std::string> precisions_{"fp32"};
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
                                  [&](const PeerRow& row) { return row.net == net && row.mode == mode && row.tuned; });
  return found == r.peers.end() ? nullptr : &*found;
}

}  // namespace

BenchStepResults measure_steps(const BenchStepOptions& options, const StudyTools& tools) {
  if (options.repeats < 1) throw Error(ErrorKind::usage, "usage.value.range", "--repeats: expected at least 1");
  return StepBench(options, tools).run();
}

namespace {

/// `time` says which of a row's times counts.
template <class Time>
Goals goals_by(const BenchStepResults& r, const Time& time) {
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
  // The worse of the two networks.
  const std::optional<double> p7 = std::max(ratio(of_classes("paper", 512), of_classes("paper", 13)),
                                            ratio(of_classes("hash T=2^15", 512), of_classes("hash T=2^15", 13)));
  return {{"P1", faster("paper", "fp32")},
          {"P2", faster("paper", "bf16")},
          {"P2c", ratio(step("hash T=2^15", "fp32"), step("hash T=2^15", "bf16"))},
          {"P3", faster("hash T=2^15", "fp32")},
          {"P4", std::nullopt},
          {"P7", p7},
          {"P8", ratio(of_classes("paper", 101), of_classes("paper", 0))},
          {"threads2", ratio(find_step(r.scaling, "paper", "fp32", kPaperClasses, 1),
                             find_step(r.scaling, "paper", "fp32", kPaperClasses, 2))},
          {"P15", r.many_threads == 0 ? std::nullopt
                                      : ratio(find_step(r.scaling, "paper", "fp32", kPaperClasses, 1),
                                              find_step(r.scaling, "paper", "fp32", kPaperClasses, r.many_threads))}};
}

std::optional<double>& goal(Goals& goals, std::string_view name) {
  return std::find_if(goals.begin(), goals.end(), [name](const auto& entry) { return entry.first == name; })->second;
}

}  // namespace

Goals goals_of(const BenchStepResults& r) {
  Goals goals = goals_by(r, [](const auto& row) { return row.seconds.median; });
  const StepRow* paper = find_step(r.steps, "paper", "fp32", kPaperClasses, r.threads);
  if (paper != nullptr && paper->peak > 0) goal(goals, "P4") = paper->flops() / paper->peak;
  return goals;
}

Goals processor_goals_of(const BenchStepResults& r) {
  Goals goals = goals_by(r, [](const auto& row) { return row.processor; });
  const StepRow* paper = find_step(r.steps, "paper", "fp32", kPaperClasses, r.threads);
  if (paper != nullptr && r.peak_fp32_one > 0) goal(goals, "P4") = paper->flop / paper->processor / r.peak_fp32_one;
  goals.resize(goals.size() - 2);  // threads2 and P15 are matters of time that passes
  return goals;
}

}  // namespace semfield
