// bench: the group of the verbs in this folder, whose studies are a library of their own.
#include "app/bench/bench_studies.h"
#include "app/verb.h"
#include "system/shared_library.h"

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

}  // namespace semfield::app
