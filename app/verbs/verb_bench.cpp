// bench: whole training steps, timed by studies that are a library of their own.
#include "app/bench/bench_studies.h"
#include "app/verb.h"
#include "system/process.h"

namespace semfield::app {

namespace {

// Most runs of the program do without the library. Throws Error(unavailable) where it is missing, naming what to build.
template <class Options>
int run_study(const char* symbol, const Options& options, AppContext& context) {
  using Study = int (*)(const Options&, AppContext&);
  const auto study =
      reinterpret_cast<Study>(part_symbol("semfield_bench", symbol, "the studies of `bench` cannot be loaded"));
  return study(options, context);
}

int run(const BenchGpuOptions& options, AppContext& context) {
  return run_study("semfield_bench_gpu", options, context);
}

void shared_words(VerbWords& verb, BenchOptions& options) {
  verb.flag("--peers", options.peers, "alternate with the same steps in PyTorch and print ratios");
  verb.value_in("--repeats N", options.repeats, 1, 1000, "rounds; figures are medians of them");
  verb.value("--python PROGRAM", options.python, "interpreter with torch (default: python3)");
}

void words(VerbWords& verb, BenchGpuOptions& options) {
  shared_words(verb, options);
  verb.value("--only NAME", options.only, "measurements whose names begin with this: --only 'paper bf16'");
}

int run(const BenchStepOptions& options, AppContext& context) {
  return run_study("semfield_bench_step", options, context);
}

void words(VerbWords& verb, BenchStepOptions& options) {
  shared_words(verb, options);
  verb.value_in("--threads N", options.threads, 1, 4096, "CPU threads (default: every core)");
  verb.choice("--size SIZE", options.size, {"full", "tiny"}, "full, or tiny: narrow networks and few rays, for tests");
  verb.repeated("--set KEY=VALUE", options.set, "override a value of both networks: --set runtime.tile_rays=8");
  verb.value("--peer-script FILE", options.peer_script, "the PyTorch script (default: the shipped one)");
}

}  // namespace

Verb verb_bench() { return make_group("bench", 180, "measure the speed of training steps"); }

Verb verb_bench_gpu() {
  return make_verb<BenchGpuOptions>("bench gpu", 20, "time training steps and frames on a GPU", words, run);
}

Verb verb_bench_step() {
  return make_verb<BenchStepOptions>("bench step", 30, "time whole training steps, next to the machine's limits", words,
                                     run);
}

}  // namespace semfield::app
