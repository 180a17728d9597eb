// runs: the group of the verbs in this folder.
#include <cstdio>

#include "app/json_output.h"
#include "app/verb.h"
#include "run/run_scores.h"

namespace semfield::app {

Verb verb_runs() { return make_group("runs", 160, "compare finished runs"); }

// runs equal: whether two finished runs are the same training.

namespace {

struct EqualOptions : Options {
  using Options::Options;
  const std::string& a = operand("run_a", "run folder");
  const std::string& b = operand("run_b", "run folder");
};

int run(const EqualOptions& options, AppContext& context) {
  Diagnostics diagnostics;
  const RunComparison found = compare_runs(options.a, options.b, context.registry, diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) print_note(context, finding.shown());
  if (context.json) {
    Json out{{"equal", found.difference.empty()}};
    if (found.difference.empty()) {
      out.update({{"step", found.step}, {"tensors", found.tensors}});
    } else {
      out["difference"] = found.difference;
    }
    print_json(context, out);
    return found.difference.empty() ? 0 : static_cast<int>(ErrorKind::failure);
  }
  if (!found.difference.empty()) {
    std::printf("runs: different: %s\n", found.difference.c_str());
    return static_cast<int>(ErrorKind::failure);
  }
  std::printf("runs: equal step=%lld tensors=%zu\n", static_cast<long long>(found.step), found.tensors);
  return 0;
}

}  // namespace

Verb verb_runs_equal() {
  return make_verb<EqualOptions>(
      "runs equal", 10,
      "check whether two runs are the same training, bit by bit; times, threads and places do not count", run);
}

}  // namespace semfield::app
