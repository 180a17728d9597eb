// bench label: clicks that a simulated person needs, by what it is asked, and how long the answers take.
#include "app/verb.h"
#include "app/verbs/bench/load_studies.h"
#include "serve/label_loop.h"

namespace semfield::app {

namespace {

int run(const BenchLabelOptions& options, AppContext& context) { return bench_studies().label(options, context); }

void words(VerbWords& verb, BenchLabelOptions& options) {
  verb.optional_operands("config", options.configs, "configurations of labelled scenes (default: the shipped room)");
  verb.repeated("--set KEY=VALUE", options.set, "override a value: --set train.rays=2048");
  verb.threads(options.set);
  verb.device(options.set);
  verb.list("--questions LIST", options.questions, "ways to ask, with commas (default: all)",
            choice_names<Acquisition>());
  verb.value_in("--seeds N", options.seeds, 1, 100,
                "persons for each way to ask; the first one's seed is runtime.seed");
  verb.value_in("--clicks N", options.clicks, 1, 2000, "clicks of a person");
  verb.positive("--geometry X", options.geometry_s, "seconds of training before the first click");
  verb.value_in("--between X", options.between_s, 0, 86400,
                "seconds of training between two clicks; 0: the geometry stands");
  verb.value_in("--timed-clicks N", options.timed_clicks, 0, 1000,
                "clicks whose answers are timed while a session trains");
  verb.list("--combine FILES", options.combine,
            "files that `--json` has written; their persons count as if they were here");
}

}  // namespace

Verb verb_bench_label() {
  return with_json(make_verb<BenchLabelOptions>(
      "bench label", 50, "count the clicks that a simulated person needs, and time the answers", words, run));
}

}  // namespace semfield::app
