// What the verbs of `bench` hand to their studies: a library of its own, loaded when asked for.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "studies/gpu_rows.h"
#include "studies/step_rows.h"

namespace semfield::app {

struct BenchLabelOptions {
  std::vector<std::string> configs;
  std::vector<std::string> set;
  std::vector<std::string> questions;
  int seeds = 5;
  int clicks = 300;
  double geometry_s = 30;
  double between_s = 2;
  int timed_clicks = 60;
  std::vector<std::string> combine;
};

struct LeaveOutOptions {
  std::vector<std::string> only;  ///< names of pairs; empty: all
  std::vector<std::string> set;
  std::string write_docs;  ///< folder of leave_out.json and leave_out.md
  int rounds = 9;
  int seeds = 5;
  int seed_steps = 400;
};

struct BenchQuadratureOptions {
  long long rays = 1024;  ///< for rules with jitter and media with jumps
  std::string out;        ///< folder for plots, tables and quadrature.json; "": none
};

struct BenchScaleOptions {
  std::string out;         ///< folder; "": a temporary one
  std::string write_docs;  ///< folder of the documents
  std::vector<std::string> only, combine;
  std::optional<int> ranks;
  int repeats = 2;
  bool quick = false;
};

/// Each measures, prints, and returns the exit code.
int bench_gpu(const BenchGpuOptions& options, AppContext& context);
int bench_label(const BenchLabelOptions& options, AppContext& context);
int bench_pairs(const LeaveOutOptions& options, AppContext& context);
int bench_quadrature(const BenchQuadratureOptions& options, AppContext& context);
int bench_scale(const BenchScaleOptions& options, AppContext& context);
int bench_step(const BenchStepOptions& options, AppContext& context);

/// What the library gives, by its one symbol.
struct BenchStudies {
  int (*gpu)(const BenchGpuOptions& options, AppContext& context) = nullptr;
  int (*label)(const BenchLabelOptions& options, AppContext& context) = nullptr;
  int (*pairs)(const LeaveOutOptions& options, AppContext& context) = nullptr;
  int (*quadrature)(const BenchQuadratureOptions& options, AppContext& context) = nullptr;
  int (*scale)(const BenchScaleOptions& options, AppContext& context) = nullptr;
  int (*step)(const BenchStepOptions& options, AppContext& context) = nullptr;
};
inline constexpr const char* kBenchStudiesSymbol = "semfield_bench_studies";

}  // namespace semfield::app
