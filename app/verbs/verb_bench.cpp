// bench: the group of the verbs in this folder, whose studies are a library of their own.
#include "app/bench/bench_studies.h"
#include "app/verb.h"
#include "system/process.h"

namespace semfield::app {

const BenchStudies& bench_studies() {
  static const BenchStudies studies = [] {
    BenchStudies loaded;
    reinterpret_cast<void (*)(BenchStudies&)>(
        part_symbol("semfield_bench", kBenchStudiesSymbol, "the studies of `bench` cannot be loaded"))(loaded);
    return loaded;
  }();
  return studies;
}

Verb verb_bench() { return make_group("bench", 180, "measure the speed of training steps"); }

// bench gpu: training steps and frames on a GPU, beside the same steps in PyTorch, as a table or JSON.

namespace {

int run(const BenchGpuOptions& options, AppContext& context) { return bench_studies().gpu(options, context); }

void words(VerbWords& verb, BenchGpuOptions& options) {
  verb.flag("--peers", options.peers, "alternate with the same steps in PyTorch and print ratios");
  verb.value("--only NAME", options.only, "measurements whose names begin with this: --only 'paper bf16'");
  verb.value_in("--repeats N", options.repeats, 1, 1000, "rounds; figures are medians of them");
  verb.value("--python PROGRAM", options.python, "interpreter with torch (default: python3)");
}

}  // namespace

Verb verb_bench_gpu() {
  return with_json(make_verb<BenchGpuOptions>("bench gpu", 20, "time training steps and frames on a GPU", words, run));
}

// bench step: whole training steps, the machine's limits and the peer, as a table or one JSON object.

namespace {

int run(const BenchStepOptions& options, AppContext& context) { return bench_studies().step(options, context); }

void words(VerbWords& verb, BenchStepOptions& options) {
  verb.flag("--peers", options.peers, "alternate with the same steps in PyTorch and print ratios");
  verb.value_in("--threads N", options.threads, 1, 4096, "CPU threads (default: every core)");
  verb.value_in("--repeats N", options.repeats, 1, 1000, "rounds; figures are medians of them");
  verb.choice("--size SIZE", options.size, {"full", "tiny"}, "full, or tiny: narrow networks and few rays, for tests");
  verb.repeated("--set KEY=VALUE", options.set, "override a value of both networks: --set runtime.tile_rays=8");
  verb.value("--peer-script FILE", options.peer_script, "the PyTorch script (default: the shipped one)");
  verb.value("--python PROGRAM", options.python, "interpreter with torch (default: python3)");
}

}  // namespace

Verb verb_bench_step() {
  return with_json(make_verb<BenchStepOptions>("bench step", 30,
                                               "time whole training steps, next to the machine's limits", words, run));
}

}  // namespace semfield::app
