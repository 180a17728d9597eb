#include "studies/gpu_rows.h"

#include <fmt/format.h>

#include <functional>
#include <memory>

#include "compute/parallel.h"
#include "core/error.h"
#include "execution/device_library.h"
#include "studies/peer.h"

namespace semfield {

namespace {

constexpr std::int64_t kFrameRays = 320 * 240;
constexpr std::int64_t kHashRays = 8192;  // of 32 samples: 2^18
constexpr int kPaperSteps = 64, kHashSteps = 128;

class GpuBench {
 public:
  GpuBench(const BenchGpuOptions& options, const StudyTools& tools) : options_(options), tools_(tools) {}

  GpuResults run() {
    results_.about = cuda_library().describe(0);
    tools_.note(results_.about);
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
    o.config = tools_.shared_file("configs/paper.yaml");
    o.set = std::move(set);
    o.classes = classes;
    return o;
  }
  StepCaseOptions hash(std::vector<std::string> set, int classes) const {
    StepCaseOptions o;
    o.config = tools_.shared_file("configs/bench/hash_step.yaml");
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
      return std::make_shared<StepCase>(options, tools_.registry);
    } catch (const Error& error) {
      tools_.note("not measured: " + name + ": " + error.what());
      return nullptr;
    }
  }

  void add_step(const std::string& name, const StepCaseOptions& options, int steps) {
    const std::shared_ptr<StepCase> step = make(name, options);
    if (!step) return;
    tools_.note("warming up: " + name);
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
      peer_ = std::make_shared<Peer>(tools_.shared_file("bench/peers/semfield_peer.py"), options_.python,
                                     hardware_threads(), false, "cuda");
      results_.peer_about = peer_->description();
    } catch (const Error& error) {
      tools_.note(std::string("no peer: ") + error.what());
      return;
    }
    std::vector<PeerRequest> requests;
    for (const char* mode : {"fp32", "tf32", "bf16", "bf16_compile"})
      requests.push_back({"paper", mode, 1024, 29, 0, 10});
    for (const PeerRequest& request : requests) {
      const std::string name = "torch " + request.net + " " + request.mode;
      try {
        tools_.note("warming up: " + name);
        PeerRequest warm_up = request;
        warm_up.steps = 5;
        peer_->measure(warm_up);
        names_.push_back(name);
        turns_.emplace_back([peer = peer_, request] { return peer->measure(request).seconds; });
      } catch (const Error& error) {
        tools_.note("not measured: " + name + ": " + error.what());
      }
    }
  }

  void measure() {
    tools_.note(fmt::format("{} rounds of {} measurements", options_.repeats, turns_.size()));
    const std::vector<Spread> spreads = alternate(turns_, options_.repeats);
    for (std::size_t i = 0; i < spreads.size(); ++i) results_.rows.push_back({names_[i], spreads[i]});
  }

  BenchGpuOptions options_;
  const StudyTools& tools_;
  std::shared_ptr<Peer> peer_;
  std::vector<std::string> names_;
  std::vector<std::function<double()>> turns_;
  GpuResults results_;
};

}  // namespace

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

GpuResults measure_gpu(const BenchGpuOptions& options, const StudyTools& tools) {
  return GpuBench(options, tools).run();
}

}  // namespace semfield
