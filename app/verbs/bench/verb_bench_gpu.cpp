// bench gpu: training steps and frames on a GPU, beside the same steps in PyTorch, as a table or JSON.
#include "app/bench/bench_studies.h"
#include "app/verb.h"

namespace semfield::app {

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

}  // namespace semfield::app
