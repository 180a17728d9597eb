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

int run(const BenchStepOptions& options, AppContext& context) {
  return run_study("semfield_bench_step", options, context);
}

}  // namespace

Verb verb_bench() { return make_group("bench", 180, "measure the speed of training steps"); }

Verb verb_bench_gpu() {
  return make_verb<BenchGpuOptions>("bench gpu", 20, "time training steps and frames on a GPU", run);
}

Verb verb_bench_step() {
  return make_verb<BenchStepOptions>("bench step", 30, "time whole training steps, next to the machine's limits", run);
}

}  // namespace semfield::app
