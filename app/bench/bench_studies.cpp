// The studies by name, as the program finds them in their library.
#include "app/bench/bench_studies.h"

extern "C" void semfield_bench_studies(semfield::app::BenchStudies& studies);
void semfield_bench_studies(semfield::app::BenchStudies& studies) {
  using namespace semfield::app;
  studies = {bench_gpu, bench_step};
}
