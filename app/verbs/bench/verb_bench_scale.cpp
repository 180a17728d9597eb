// bench scale: steps on 1, 2, ... ranks or GPUs, beside a model of what more of them would give.
#include "app/verb.h"
#include "app/verbs/bench/load_studies.h"
#include "studies/scale_bench.h"

namespace semfield::app {

namespace {

int run(const BenchScaleOptions& options, AppContext& context) { return bench_studies().scale(options, context); }

void words(VerbWords& verb, BenchScaleOptions& options) {
  verb.value("--out FOLDER", options.out, "folder for results.json, scale.md and scale.svg");
  verb.value_in("--ranks N", options.ranks, 1, 1024, "ranks at most (default: as many as there are cores or GPUs)");
  verb.list("--only LIST", options.only, "parts to measure, with commas (default: all)", kScaleParts);
  verb.value_in("--repeats N", options.repeats, 1, 100, "rounds, each of which starts every training once");
  verb.flag("--quick", options.quick, "narrow networks and few rays, for tests");
  verb.list("--combine FILES", options.combine,
            "files results.json; their figures count as if they were measured here, and nothing else is measured "
            "without --only");
  verb.value("--write-docs FOLDER", options.write_docs,
             "folder of the documents, in which evidence/scale.md, its data and its figure are renewed: docs");
}

}  // namespace

Verb verb_bench_scale() {
  return with_json(make_verb<BenchScaleOptions>(
      "bench scale", 35, "time steps on several ranks or GPUs, compare their bits, and model many more", words, run));
}

}  // namespace semfield::app
