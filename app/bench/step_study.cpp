// bench step: whole training steps, the machine's limits and the peer, as a table or one JSON object.
#include <fmt/format.h>

#include <cstdio>
#include <nlohmann/json.hpp>

#include "app/bench/bench_studies.h"
#include "app/bench/bench_tools.h"
#include "app/json_output.h"
#include "compute/isa.h"
#include "run/run_folder.h"
#include "studies/step_rows.h"

namespace semfield::app {

namespace {

std::string ratio_text(const std::optional<double>& value) {
  if (!value) return "n/a";
  return *value >= 9.995 ? fmt::format("{:.1f}", *value) : fmt::format("{:.2f}", *value);
}

std::string goal_line(const std::string& head, const Goals& goals) {
  std::string line = head;
  for (const auto& [name, value] : goals) line += " " + name + "=" + ratio_text(value);
  return line;
}

void print_rows(const char* title, const std::vector<StepRow>& rows) {
  if (rows.empty()) return;
  std::printf("\n%s\n%-12s %-5s %7s %7s %6s  %10s  %-21s %9s %12s %9s %8s %10s\n", title, "net", "", "threads",
              "classes", "rays", "s per step", "(min .. max)", "core s", "samples/s", "GFLOP/s", "of peak",
              "allocated");
  for (const StepRow& row : rows) {
    const std::string classes = row.classes == 0 ? "none" : std::to_string(row.classes);
    const std::string range = fmt::format("({:.4f} .. {:.4f})", row.seconds.min, row.seconds.max);
    const std::string share = row.peak > 0 ? fmt::format("{:.2f}", row.flops() / row.peak) : "-";
    std::printf("%-12s %-5s %7d %7s %6lld  %10.4f  %-21s %9.4f %12.0f %9.1f %8s %10lld\n", row.net.c_str(),
                row.precision.c_str(), row.threads, classes.c_str(), static_cast<long long>(row.rays),
                row.seconds.median, range.c_str(), row.processor, row.rate(), row.flops() * 1e-9, share.c_str(),
                static_cast<long long>(row.allocated));
  }
}

void print_peers(const BenchStepResults& results) {
  if (!results.peer_about.empty()) std::printf("\npeer: %s\n", results.peer_about.c_str());
  for (const PeerRow& row : results.peers) {
    std::printf("%-12s %-5s %-13s %6lld rays  %10.4f  (%.4f .. %.4f) %9.4f core s %12.0f samples/s\n", row.net.c_str(),
                row.mode.c_str(), row.tuned ? "tuned" : "as installed", static_cast<long long>(row.rays),
                row.seconds.median, row.seconds.min, row.seconds.max, row.processor, row.rate());
  }
  for (const StepRow& ours : results.steps) {
    for (const PeerRow& row : results.peers) {
      if (row.net == ours.net && row.mode == ours.precision) {
        std::printf("ours / peer's rate, %s %s (%s): %.2f\n", row.net.c_str(), row.mode.c_str(),
                    row.tuned ? "tuned" : "as installed", ours.rate() / row.rate());
      }
    }
  }
  if (!results.peer_missing.empty()) std::printf("not measured: %s\n", results.peer_missing.c_str());
}

void print_table(const BenchStepOptions& options, const BenchStepResults& r) {
  const Environment e = this_environment();
  std::printf("machine    %s, %d cores; %d threads; %s, %s\n", e.cpu.c_str(), e.hardware_threads, r.threads,
              e.compiler.c_str(), e.build_type.c_str());
  std::printf("multiply-adds from registers, GFLOP/s on 1 and %d threads: fp32 %.1f, %.1f; bf16 %.1f, %.1f\n",
              r.threads, r.peak_fp32_one * 1e-9, r.peak_fp32 * 1e-9, r.peak_bf16_one * 1e-9, r.peak_bf16 * 1e-9);
  for (const auto& [size, rates] : r.reads) {
    std::printf("random 8-byte reads from %-6s G/s on 1 and %d threads: %.2f, %.2f\n", size.c_str(), r.threads,
                rates.first * 1e-9, rates.second * 1e-9);
  }
  std::printf("matrix products: %s\n", std::string(isa_name(isa())).c_str());
  std::printf("medians of %d rounds, every measurement once per round; networks and rays: %s\n", options.repeats,
              options.size.c_str());
  std::printf(
      "GFLOP/s count the multiply-adds of the networks that are executed (exact savings taken off), not those of "
      "encodings, sampling, compositing and Adam\n");
  print_rows("whole steps", r.steps);
  print_rows("over the number of classes (fewer rays per step for the paper's network)", r.classes);
  print_rows("threads", r.scaling);
  print_peers(r);
}

Json spread_json(const Spread& s) { return {{"median", s.median}, {"min", s.min}, {"max", s.max}}; }

Json rows_json(const std::vector<StepRow>& rows) {
  Json all = Json::array();
  for (const StepRow& row : rows) {
    all.push_back({{"net", row.net},
                   {"precision", row.precision},
                   {"threads", row.threads},
                   {"classes", row.classes},
                   {"rays", row.rays},
                   {"seconds", spread_json(row.seconds)},
                   {"processor_s", row.processor},
                   {"samples_per_s", row.rate()},
                   {"flop", row.flop},
                   {"flops", row.flops()},
                   {"peak_share", row.peak > 0 ? Json(row.flops() / row.peak) : Json(nullptr)},
                   {"allocated_bytes", row.allocated}});
  }
  return all;
}

Json results_json(const BenchStepOptions& options, const BenchStepResults& r) {
  Json out = Json::parse(environment_json(this_environment()));
  out["threads"] = r.threads;
  out["repeats"] = options.repeats;
  out["size"] = options.size;
  out["isa"] = std::string(isa_name(isa()));
  out["peak_fp32_flops"] = {r.peak_fp32_one, r.peak_fp32};
  out["peak_bf16_flops"] = {r.peak_bf16_one, r.peak_bf16};
  for (const auto& [size, rates] : r.reads) out["random_reads_per_s"][size] = {rates.first, rates.second};
  out["steps"] = rows_json(r.steps);
  out["classes"] = rows_json(r.classes);
  out["scaling"] = rows_json(r.scaling);
  out["peers"] = Json::array();
  for (const PeerRow& row : r.peers) {
    out["peers"].push_back({{"net", row.net},
                            {"mode", row.mode},
                            {"tuned", row.tuned},
                            {"rays", row.rays},
                            {"seconds", spread_json(row.seconds)},
                            {"processor_s", row.processor},
                            {"samples_per_s", row.rate()}});
  }
  out["peer"] = r.peer_about;
  out["not_measured"] = r.peer_missing;
  for (const auto& [name, value] : goals_of(r)) out["goals"][name] = value ? Json(*value) : Json(nullptr);
  for (const auto& [name, value] : processor_goals_of(r))
    out["goals_by_processor_time"][name] = value ? Json(*value) : Json(nullptr);
  return out;
}

}  // namespace

int bench_step(const BenchStepOptions& options, AppContext& context) {
  const BenchStepResults results = measure_steps(options, study_tools(context));
  if (context.json) {
    print_json(context, results_json(options, results));
    return 0;
  }
  print_table(options, results);
  std::printf("\n%s\n%s isa=%s\n", goal_line("by CPU time:", processor_goals_of(results)).c_str(),
              goal_line("bench:", goals_of(results)).c_str(), std::string(isa_name(isa())).c_str());
  return 0;
}

}  // namespace semfield::app
