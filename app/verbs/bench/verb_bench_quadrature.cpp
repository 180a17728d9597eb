// bench quadrature: every rule of the rendering integral on media whose integrals are known.
#include "app/verb.h"
#include "app/verbs/bench/load_studies.h"

namespace semfield::app {

namespace {

int run(const BenchQuadratureOptions& options, AppContext& context) {
  return bench_studies().quadrature(options, context);
}

void words(VerbWords& verb, BenchQuadratureOptions& options) {
  verb.value_in("--rays N", options.rays, 16, 1000000, "number of rays for jittered rules and media with jumps");
  verb.value("--out FOLDER", options.out, "folder for plots (SVG), tables.md and quadrature.json");
}

}  // namespace

Verb verb_bench_quadrature() {
  return with_json(make_verb<BenchQuadratureOptions>(
      "bench quadrature", 10,
      "measure the error of every sampler rule of the rendering integral, against evaluations and time", words, run));
}

}  // namespace semfield::app
