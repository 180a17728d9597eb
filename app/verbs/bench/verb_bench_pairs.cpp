// bench pairs: every left-out component against the run that keeps it; --write-docs renews the shipped table.
#include "app/verb.h"
#include "app/verbs/bench/load_studies.h"

namespace semfield::app {

namespace {

int run(const LeaveOutOptions& options, AppContext& context) { return bench_studies().pairs(options, context); }

void words(VerbWords& verb, LeaveOutOptions& options) {
  verb.repeated("--only PAIR", options.only, "pairs to run (default: all)");
  verb.value_in("--rounds N", options.rounds, 1, 1000, "number of alternating timed rounds");
  verb.value_in("--seeds N", options.seeds, 2, 1000, "runs on each side of a statistical pair");
  verb.value_in("--steps N", options.seed_steps, 20, 1000000, "steps of each of these runs");
  verb.repeated("--set KEY=VALUE", options.set, "override a value of all pairs: --set train.rays=200");
  verb.value("--write-docs FOLDER", options.write_docs,
             "folder in which leave_out.json and leave_out.md are renewed: docs/reference");
}

}  // namespace

Verb verb_bench_pairs() {
  return with_json(make_verb<LeaveOutOptions>(
      "bench pairs", 40, "compare runs that leave a component out with runs that keep it: the proof, and what it saves",
      words, run));
}

}  // namespace semfield::app
