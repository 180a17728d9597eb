// bench gpu: training steps and frames on a GPU, beside the same steps in PyTorch, as a table or JSON.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <functional>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <vector>

#include "app/bench/bench_studies.h"
#include "app/bench/peer.h"
#include "app/bench/step_case.h"
#include "app/json_output.h"
#include "compute/parallel.h"
#include "core/error.h"
#include "execution/device_library.h"
#include "system/shared_files.h"

namespace semfield::app {

namespace {

struct GpuRow {
  std::string name;
  Spread seconds;
};

struct GpuResults {
  std::string about, peer_about;  ///< the device; who answered as peer
  std::vector<GpuRow> rows;

  std::optional<double> ms(const std::string& name) const;
  /// Of the peer's fastest mode.
  std::optional<double> best_peer_ms() const;
  std::optional<double> ratio(const std::string& over, const std::string& under) const;
};

constexpr std::int64_t kFrameRays = 320 * 240;
constexpr std::int64_t kHashRays = 8192;  // of 32 samples: 2^18
constexpr int kPaperSteps = 64, kHashSteps = 128;

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
                                     false, "cuda");
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

std::optional<double> GpuResults::ms(const std::string& name) const {
  for (const GpuRow& row : rows) {
    if (row.name == name) return 1e3 * row.seconds.median;
  }
  return std::nullopt;
}

std::optional<double> GpuResults::best_peer_ms() const {
  std::optional<double> best;
  for (const GpuRow& row : rows) {
    if (row.name.starts_with("torch paper") && (!best || 1e3 * row.seconds.median < *best))
      best = 1e3 * row.seconds.median;
  }
  return best;
}

std::optional<double> GpuResults::ratio(const std::string& over, const std::string& under) const {
  const std::optional<double> a = ms(over), b = ms(under);
  return a && b ? std::optional<double>(*a / *b) : std::nullopt;
}

/// What cannot be measured is a note. Throws Error(unavailable) without a device.
GpuResults measure_gpu(const BenchGpuOptions& options, AppContext& context) { return GpuBench(options, context).run(); }

constexpr double kLimit_ms =
    1.09;  // of the paper step's multiply-adds in bf16 at 790 TFLOP/s, a good product on an H200

std::string text_of(const std::optional<double>& value, int digits) {
  return value ? fmt::format("{:.{}f}", *value, digits) : "n/a";
}

}  // namespace

int bench_gpu(const BenchGpuOptions& options, AppContext& context) {
  const GpuResults bench = measure_gpu(options, context);
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

}  // namespace semfield::app
