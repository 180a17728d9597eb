#include "app/verbs/bench/load_studies.h"

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

}  // namespace semfield::app
