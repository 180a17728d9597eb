#include "studies/scale_page.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <utility>

#include "report/html.h"
#include "studies/page_parts.h"

namespace semfield {

namespace {

constexpr int kMostDevices = 1024;
constexpr const char* kScaleStudy = "study scale";
constexpr std::array<std::pair<const char*, const char*>, 4> kKinds{
    {{"paper", "cpu"}, {"hash", "cpu"}, {"paper", "cuda"}, {"hash", "cuda"}}};

// Assumed, not measured: what such links give to one process at a time, latency of the library included.
const ScaleLink kSharedMemory{"shared memory", 2e-6, 5e9};
const ScaleLink kNvlink{"NVLink", 4e-6, 350e9};
const ScaleLink kNetwork{"100 Gb/s network", 10e-6, 11e9};

// What runtime.lanes: 0 chooses for these steps.
constexpr int kLanes = 48;
// A message of the chain holds 64 pieces of gradients of 4 KiB at most.
constexpr double kMessageBytes = 256 << 10;
// What `semfield-study scale` sets: 30 samples per ray, each with its place (3 float64) and the gradient of 32 encoded
// numbers.
constexpr double kHashRowBytes = 30 * (3 * 8 + 32 * 4);

ScaleSystem system_of(const std::string& device) {
  if (device == "cuda") return {"hosts of 8 GPUs", ScaleExchange::all_reduce, 8, kNvlink, kNetwork, 1};
  return {"hosts of 16 cores, a rank of one thread on each",
          ScaleExchange::chain,
          16,
          kSharedMemory,
          kNetwork,
          kMessageBytes};
}

// Three digits, and all of those before the point.
std::string number_text(double value) {
  return value >= 100  ? fmt::format("{:.0f}", value)
         : value >= 10 ? fmt::format("{:.1f}", value)
                       : fmt::format("{:.3g}", value);
}
std::string ms_text(double seconds) { return number_text(1e3 * seconds); }

std::string times_text(double times) { return fmt::format(fmt::runtime(times < 99.95 ? "{:.2f}" : "{:.0f}"), times); }

std::string spread_text(const ScaleRow& row) {
  return fmt::format("{} ({} .. {})", ms_text(row.seconds.median), ms_text(row.seconds.min), ms_text(row.seconds.max));
}

std::string title_of(const std::string& step, const std::string& device) {
  return fmt::format("{} step on {}", step == "paper" ? "Paper" : "Hash", device == "cuda" ? "GPUs" : "CPU ranks");
}

// Where a figure of the last line is measured.
const char* machine_for(const std::string& goal) {
  if (goal.starts_with("gpu2")) return "two GPUs";
  return goal.starts_with("cpu16") ? "16 cores" : "two cores";
}

// Numbers of ranks that were measured on the machine with this step.
std::vector<int> ranks_of(const ScaleResults& results, const ScaleMachine& machine, const std::string& step) {
  std::vector<int> ranks;
  for (const ScaleRow& row : results.rows) {
    if (row.machine == machine.name && row.step == step) ranks.push_back(row.ranks);
  }
  std::sort(ranks.begin(), ranks.end());
  ranks.erase(std::unique(ranks.begin(), ranks.end()), ranks.end());
  return ranks;
}

// Time and speed-up of one number of ranks.
std::string measured_cells(const ScaleResults& results, const ScaleMachine& machine, const std::string& step, int ranks,
                           bool strong) {
  const ScaleSizes sizes = scale_sizes(step, machine.device, results.quick);
  const ScaleRow* row = results.find(machine.name, step, ranks, strong ? sizes.strong : sizes.weak * ranks);
  const auto times = measured_speedup(results, machine, step, ranks, strong);
  if (row == nullptr || !times) return " not measured | - |";
  return fmt::format(" {} | {} |", spread_text(*row), times_text(*times));
}

std::string measured_table(const ScaleResults& results, const ScaleMachine& machine, const std::string& step) {
  const std::vector<int> ranks = ranks_of(results, machine, step);
  if (ranks.empty()) return {};
  const ScaleSizes sizes = scale_sizes(step, machine.device, results.quick);
  std::string text = fmt::format(
      "\n{}, {}:\n\n| ranks | {} rays in all, ms | x of n | {} rays per rank, ms | x of n |\n|---|---|---|---|---|\n",
      title_of(step, machine.device), machine.name, sizes.strong, sizes.weak);
  for (const int n : ranks)
    text += fmt::format("| {} |{}{}\n", n, measured_cells(results, machine, step, n, true),
                        measured_cells(results, machine, step, n, false));
  return text;
}

std::string bits_table(const ScaleResults& results) {
  if (results.bits.empty()) return {};
  std::vector<std::pair<std::string, std::string>> trainings;  // name and machine, each once
  for (const ScaleBits& row : results.bits) {
    const std::pair<std::string, std::string> training{row.name, row.machine};
    if (std::find(trainings.begin(), trainings.end(), training) == trainings.end()) trainings.push_back(training);
  }
  std::string text = "\n| training | machine | ranks x threads | bits |\n|---|---|---|---|\n";
  for (const auto& [name, machine] : trainings) {
    std::string arrangements, differs;
    for (const ScaleBits& row : results.bits) {
      if (row.name != name || row.machine != machine) continue;
      const std::string here = fmt::format("{} x {}", row.ranks, row.threads);
      arrangements += (arrangements.empty() ? "" : ", ") + here;
      if (row.difference.empty()) continue;
      differs += fmt::format("{}{}: {}", differs.empty() ? "" : "; ", here, row.difference);
    }
    text += fmt::format("| {} | {} | {} | {} |\n", name, machine, arrangements, differs.empty() ? "equal" : differs);
  }
  return text;
}

std::string sweep_table(const ScaleResults& results) {
  if (results.sweeps.empty()) return {};
  std::string text = "\n| sweep | machine | by one, s | by two, s | x of 2 |\n|---|---|---|---|---|\n";
  for (const ScaleSweep& row : results.sweeps)
    text += fmt::format("| {} cells, {} | {} | {:.1f} | {:.1f} | {:.2f} |\n", row.cells, row.workers, row.machine,
                        row.one_s, row.two_s, row.one_s / row.two_s);
  return text;
}

// "up to 37 devices"
std::string limit_text(int devices) {
  return devices >= kMostDevices ? fmt::format("{} and more", kMostDevices) : std::to_string(devices);
}

std::string limits_text(const ScaleCase& c, bool strong) {
  const double rays = static_cast<double>(strong ? c.sizes.strong : c.sizes.weak);
  const ScaleLimits limits = scale_limits(c.cost, c.system, rays, strong, kMostDevices);
  const double least = predict_step(c.cost, c.system, limits.fastest, strong ? rays : rays * limits.fastest).step_s();
  return fmt::format(
      "{}: half of each device or more is of use up to {} devices; 99 % of the most rays per second on {} ({} ms)",
      strong ? "Strong" : "Weak", limit_text(limits.half_efficient), limit_text(limits.fastest), ms_text(least));
}

std::string predicted_cells(const ScaleResults& results, const ScaleCase& c, int devices, bool strong) {
  const double rays = static_cast<double>(strong ? c.sizes.strong : c.sizes.weak);
  const ScaleTime time = predict_step(c.cost, c.system, devices, strong ? rays : rays * devices);
  const auto measured = measured_speedup(results, c.machine, c.step, devices, strong);
  return fmt::format(" {} | {} | {} | {} |", ms_text(time.step_s()), ms_text(time.exposed_s),
                     times_text(predict_speedup(c.cost, c.system, devices, rays, strong)),
                     measured ? times_text(*measured) : "-");
}

std::string case_table(const ScaleResults& results, const ScaleCase& c) {
  std::string text = fmt::format(
      "\n### {}\n\nOne device: {}. Many: {}, {} within, {} between.\n\n"
      "| devices | {} rays in all, ms | of it exchange | x | measured | {} rays per device, ms | of it exchange | x | "
      "measured |\n|---|---|---|---|---|---|---|---|---|\n",
      title_of(c.step, c.device), c.machine.name, c.system.name, c.system.inside.name, c.system.between.name,
      c.sizes.strong, c.sizes.weak);
  for (int devices = 1; devices <= kMostDevices; devices *= 2)
    text += fmt::format("| {} |{}{}\n", devices, predicted_cells(results, c, devices, true),
                        predicted_cells(results, c, devices, false));
  return text + fmt::format("\n{}. {}.\n", limits_text(c, true), limits_text(c, false));
}

PlotSeries model_series(const ScaleCase& c, bool strong, int color) {
  PlotSeries series;
  series.name = c.step + ", model";
  series.color = color;
  const double rays = static_cast<double>(strong ? c.sizes.strong : c.sizes.weak);
  for (int devices = 1; devices <= kMostDevices; devices *= 2)
    series.points.push_back(
        {static_cast<double>(devices), predict_speedup(c.cost, c.system, devices, rays, strong) / devices});
  return series;
}

PlotSeries measured_series(const ScaleResults& results, const ScaleCase& c, bool strong, int color) {
  PlotSeries series;
  series.name = c.step + ", measured";
  series.color = color;
  for (const int ranks : ranks_of(results, c.machine, c.step)) {
    if (const auto times = measured_speedup(results, c.machine, c.step, ranks, strong))
      series.points.push_back({static_cast<double>(ranks), *times / ranks});
  }
  return series;
}

}  // namespace

std::vector<ScaleCase> scale_cases(const ScaleResults& results) {
  std::vector<ScaleCase> cases;
  for (const auto& [step, device] : kKinds) {
    const ScaleMachine* machine = nullptr;
    for (const ScaleMachine& m : results.machines) {
      const bool measured = m.device == device && !ranks_of(results, m, step).empty();
      if (measured && (machine == nullptr || m.units > machine->units)) machine = &m;
    }
    if (machine == nullptr) continue;
    const bool cuda = machine->device == "cuda", paper = std::string(step) == "paper";
    std::vector<ScaleSample> samples;
    double dense = 0, table = 0;
    const ScaleRow* two = nullptr;
    for (const ScaleRow& row : results.rows) {
      if (row.machine != machine->name || row.step != step) continue;
      dense = row.gradient_bytes;
      table = row.table_bytes;
      const double rays = static_cast<double>(row.rays);
      if (row.ranks == 1) samples.push_back({rays, row.seconds.median});
      if (row.ranks == 2 && row.rays == scale_sizes(step, device, results.quick).strong) two = &row;
    }
    if (samples.empty()) continue;
    ScaleCase c{step, device, *machine, fit_step(samples), system_of(device), scale_sizes(step, device, results.quick)};
    c.cost.gradient_bytes = dense + (cuda ? table : 0);
    if (cuda && paper) {
      c.cost.overlapped_share = 0.5;  // the first of two networks
      c.cost.hiding_share = 0.75;     // the second has 192 of a ray's 256 samples
    }
    if (!cuda) c.cost.lanes = kLanes;
    if (!cuda && !paper) {
      c.cost.gathered_bytes_per_ray = kHashRowBytes;
      if (two != nullptr)
        c.cost = with_repeated(c.cost, c.system, 2, {static_cast<double>(two->rays), two->seconds.median});
    }
    cases.push_back(std::move(c));
  }
  return cases;
}

std::string scale_measured(const ScaleResults& results) {
  std::string text;
  for (const ScaleMachine& machine : results.machines) text += fmt::format("- {}: {}.\n", machine.name, machine.about);
  for (const ScaleMachine& machine : results.machines) {
    for (const char* step : {"paper", "hash"}) text += measured_table(results, machine, step);
  }
  text += bits_table(results) + sweep_table(results);
  std::string missing;
  for (const auto& [name, value] : scale_goals(results)) {
    if (value != "-") continue;
    missing += fmt::format("{}`{}` on a machine with {}", missing.empty() ? "" : ", ", name, machine_for(name));
  }
  if (!missing.empty()) text += "\nNot measured: " + missing + ". `semfield-study scale` measures it there.\n";
  return text + "\n```text\n" + scale_line(results) + "\n```\n";
}

std::string scale_model(const ScaleResults& results) {
  const std::vector<ScaleCase> cases = scale_cases(results);
  if (cases.empty()) return "No step was timed on one rank, on which the model could stand.\n";
  std::string text =
      "| step | every device, ms | dealt out, µs per ray | every device for all rays, µs per ray | gradients, MB | "
      "gathered, "
      "kB per ray |\n|---|---|---|---|---|---|\n";
  for (const ScaleCase& c : cases)
    text +=
        fmt::format("| {} | {} | {} | {} | {:.1f} | {:.1f} |\n", title_of(c.step, c.device), ms_text(c.cost.fixed_s),
                    number_text(1e6 * c.cost.split_s_per_ray), number_text(1e6 * c.cost.repeated_s_per_ray),
                    1e-6 * c.cost.gradient_bytes, 1e-3 * c.cost.gathered_bytes_per_ray);
  text += "\n| link, assumed | latency, µs | GB/s |\n|---|---|---|\n";
  for (const ScaleLink& link : {kSharedMemory, kNvlink, kNetwork})
    text += fmt::format("| {} | {:.0f} | {:.0f} |\n", link.name, 1e6 * link.latency_s, 1e-9 * link.bytes_per_s);
  for (const ScaleCase& c : cases) text += case_table(results, c);
  return text;
}

std::string scale_figure(const ScaleResults& results) {
  const std::vector<ScaleCase> cases = scale_cases(results);
  std::vector<PlotSpec> panels;
  for (const char* device : {"cpu", "cuda"}) {
    for (const bool strong : {true, false}) {
      PlotSpec spec;
      spec.title = fmt::format("{}, {}", std::string(device) == "cuda" ? "GPUs" : "CPU ranks",
                               strong ? "rays shared out" : "the same rays on each");
      spec.x_label = "devices";
      spec.log_x = spec.markers = true;
      spec.end_values = false;
      spec.y_range = PlotRange{0, 1};
      for (const ScaleCase& c : cases) {
        if (c.device != device) continue;
        const int color = c.step == "paper" ? 0 : 2;
        spec.series.push_back(model_series(c, strong, color));
        spec.series.push_back(measured_series(results, c, strong, color + 1));
      }
      if (!spec.series.empty()) panels.push_back(std::move(spec));
    }
  }
  return figure_svg("Share of each device that is of use", panels, 2);
}

std::string scale_line(const ScaleResults& results) {
  std::string line = "scale:";
  for (const auto& [name, value] : scale_goals(results)) line += fmt::format(" {}={}", name, value);
  return line;
}

std::string with_scale(std::string page, const ScaleResults& results, const std::string& name) {
  put_part(page, kScaleStudy, "measured", scale_measured(results), name);
  put_part(page, kScaleStudy, "model", scale_model(results), name);
  return page;
}

}  // namespace semfield
