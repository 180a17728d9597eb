// bench gpu: training steps and frames on a GPU, beside the same steps in PyTorch, as a table or JSON.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <nlohmann/json.hpp>
#include <optional>
#include <vector>

#include "app/bench/bench_studies.h"
#include "app/bench/bench_tools.h"
#include "app/json_output.h"
#include "studies/gpu_rows.h"

namespace semfield::app {

namespace {

constexpr double kLimit_ms =
    1.09;  // of the paper step's multiply-adds in bf16 at 790 TFLOP/s, a good product on an H200

std::string text_of(const std::optional<double>& value, int digits) {
  return value ? fmt::format("{:.{}f}", *value, digits) : "n/a";
}

}  // namespace

int bench_gpu(const BenchGpuOptions& options, AppContext& context) {
  const GpuResults bench = measure_gpu(options, study_tools(context));
  const std::optional<double> step = bench.ms("paper bf16 C=29"), peer = bench.best_peer_ms();
  const std::optional<double> frame = bench.ms("frame 320x240 bf16");
  const std::vector<std::pair<std::string, std::string>> goals{
      {"step_ms", text_of(step, 3)},
      {"torch_best_ms", text_of(peer, 2)},
      {"P5", text_of(step && peer ? std::optional<double>(*peer / *step) : std::nullopt, 2)},
      {"P6", text_of(step ? std::optional<double>(*step / kLimit_ms) : std::nullopt, 2)},
      {"P7", text_of(std::max(bench.ratio("paper bf16 C=512", "paper bf16 C=13"),
                              bench.ratio("hash bf16 C=512", "hash bf16 C=13")),
                     3)},
      {"P8", text_of(bench.ratio("paper bf16 C=101", "paper bf16 C=0"), 3)},
      {"P11", text_of(std::max(bench.ratio("paper bf16 C=29 deterministic", "paper bf16 C=29"),
                               bench.ratio("hash bf16 C=29 deterministic", "hash bf16 C=29")),
                      3)},
      {"frame_fps", text_of(frame ? std::optional<double>(1e3 / *frame) : std::nullopt, 1)},
      {"hash_ms", text_of(bench.ms("hash bf16 C=29"), 3)}};
  if (context.json) {
    Json out{{"device", bench.about}, {"peer", bench.peer_about}};
    for (const GpuRow& row : bench.rows)
      out["ms"][row.name] = {1e3 * row.seconds.median, 1e3 * row.seconds.min, 1e3 * row.seconds.max};
    for (const auto& [name, value] : goals) out["goals"][name] = value;
    print_json(context, out);
    return 0;
  }
  std::printf("device     %s\n", bench.about.c_str());
  if (!bench.peer_about.empty()) std::printf("peer       %s\n", bench.peer_about.c_str());
  std::printf("medians of %d rounds, every measurement once per round\n%-32s %10s  %s\n", options.repeats, "", "ms",
              "(min .. max)");
  for (const GpuRow& row : bench.rows) {
    std::printf("%-32s %10.3f  (%.3f .. %.3f)\n", row.name.c_str(), 1e3 * row.seconds.median, 1e3 * row.seconds.min,
                1e3 * row.seconds.max);
  }
  std::string line = "bench gpu:";
  for (const auto& [name, value] : goals) line += " " + name + "=" + value;
  std::printf("%s\n", line.c_str());
  return 0;
}

}  // namespace semfield::app
