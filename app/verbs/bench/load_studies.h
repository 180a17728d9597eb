// The studies of `bench`, which most runs of the program do without.
#pragma once

#include "app/bench/bench_studies.h"

namespace semfield::app {

/// Loads their library. Throws Error(unavailable) where it is missing, naming what to build.
const BenchStudies& bench_studies();

}  // namespace semfield::app
