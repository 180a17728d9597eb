// What the verbs of `bench` hand to their studies: a library of its own, loaded when asked for.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "studies/gpu_rows.h"
#include "studies/step_rows.h"

namespace semfield::app {

/// Each measures, prints, and returns the exit code.
int bench_gpu(const BenchGpuOptions& options, AppContext& context);
int bench_step(const BenchStepOptions& options, AppContext& context);

/// What the library gives, by its one symbol.
struct BenchStudies {
  int (*gpu)(const BenchGpuOptions& options, AppContext& context) = nullptr;
  int (*step)(const BenchStepOptions& options, AppContext& context) = nullptr;
};
inline constexpr const char* kBenchStudiesSymbol = "semfield_bench_studies";

}  // namespace semfield::app
