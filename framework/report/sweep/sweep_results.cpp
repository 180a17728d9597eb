#include "report/sweep/sweep_results.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <tuple>

#include "config/params_read.h"
#include "formats/text_rows.h"
#include "run/metrics_log.h"
#include "system/files.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

Json parse(const std::string& text, const std::string& name) {
  try {
    return Json::parse(text);
  } catch (const nlohmann::json::exception& e) {
    throw Error(ErrorKind::data, "sweep.result.damaged", name + ": not valid JSON: " + e.what(),
                "remove the cell's folder and run it again");
  }
}

CellValues numbers_of(const Json& map) {
  CellValues out;
  for (const auto& [key, value] : map.items()) {
    if (value.is_number()) out.emplace_back(key, value.get<double>());
  }
  return out;
}

// The last evaluation of a split, null without any. Training frames are scored once, as many as the experiment asks
// for.
const MetricsRow* last_row(const std::vector<MetricsRow>& rows, const std::string& split) {
  const auto last = std::find_if(rows.rbegin(), rows.rend(), [&](const MetricsRow& row) {
    return row.kind == "eval" && (row.split == split || (split == "train" && row.split == split + kSampleSuffix));
  });
  return last == rows.rend() ? nullptr : &*last;
}

}  // namespace

void write_cell_result(const std::string& path, const CellValues& values) {
  Json map = Json::object();
  for (const auto& [name, value] : values) {
    if (std::isfinite(value)) map[name] = value;
  }
  write_file_atomic(path, Json{{"values", map}}.dump(1) + "\n");
}

std::optional<CellValues> read_cell_result(const std::string& path) {
  if (!std::filesystem::exists(path)) return std::nullopt;
  const Json root = parse(read_text_file(path), path);
  if (!root.is_object() || !root.contains("values") || !root["values"].is_object())
    throw Error(ErrorKind::data, "sweep.result.damaged", path + ": no map 'values' in it",
                "remove the cell's folder and run it again");
  return numbers_of(root["values"]);
}

CellValues values_of_run(const std::string& metrics_path, const std::string& split) {
  const std::vector<MetricsRow> rows = read_metrics(metrics_path);
  const MetricsRow* const last = last_row(rows, split);
  if (last == nullptr)
    throw Error(ErrorKind::data, "scene.split.empty", metrics_path + ": no evaluation of the split '" + split + "'",
                "the scene needs frames in that split; see `semfield inspect`");
  CellValues out;
  for (const auto& [name, value] : last->values) {
    if (value && std::isfinite(*value)) out.emplace_back(name, *value);
  }
  // Beside held-out frames, the training frames that the experiment asked for.
  if (const MetricsRow* const train = split == "test" ? last_row(rows, "train") : nullptr; train != nullptr) {
    for (const auto& [name, value] : train->values) {
      if (!value || !std::isfinite(*value)) continue;
      out.emplace_back(name.starts_with(kGivenPrefix) ? name : std::string(kTrainingPrefix) + name, *value);
    }
  }
  out.emplace_back("train_s", last->train_s);
  out.emplace_back("steps", static_cast<double>(last->step));
  return out;
}

CellValues values_of_fusion(const std::string& json, const std::string& method) {
  const Json root = parse(json, "result of semfield fuse");
  for (const Json& row : root.is_object() ? root.value("scores", Json::array()) : Json::array()) {
    if (row.is_object() && row.value("method", "") == method) return numbers_of(row);
  }
  throw Error(ErrorKind::data, "sweep.result.missing", "semfield fuse gave no result for the method '" + method + "'");
}

CellValues values_of_objects(const std::string& json) {
  const Json root = parse(json, "result of semfield objects");
  if (!root.is_object() || !root.contains("score") || !root.contains("seconds"))
    throw Error(ErrorKind::data, "sweep.result.missing", "semfield objects gave no figures");
  CellValues values = numbers_of(root["score"]);
  for (const auto& [part, seconds] : numbers_of(root["seconds"]))
    values.emplace_back((part == "all" ? "objects" : part) + "_s", seconds);
  return values;
}

std::string results_csv(const Sweep& sweep, const std::vector<Cell>& cells, const SweepResults& results) {
  struct Line {
    CellUse use;
    const Cell* cell;
  };
  std::vector<Line> lines;
  for (const Cell& cell : cells) {
    for (const CellUse& use : cell.uses) lines.push_back({use, &cell});
  }
  std::sort(lines.begin(), lines.end(), [](const Line& a, const Line& b) {
    return std::tie(a.use.experiment, a.use.scene, a.use.variant, a.use.seed) <
           std::tie(b.use.experiment, b.use.scene, b.use.variant, b.use.seed);
  });
  std::string out = "experiment,scene,variant,seed,metric,value\n";
  for (const Line& line : lines) {
    const auto found = results.find(line.cell->id);
    if (found == results.end()) continue;
    const Experiment& e = sweep.experiments[line.use.experiment];
    const std::string start = csv_field(e.name) + "," + csv_field(e.scenes[line.use.scene].name) + "," +
                              csv_field(e.variants[line.use.variant].name) + "," +
                              std::to_string(e.seeds[line.use.seed]) + ",";
    for (const auto& [name, value] : found->second)
      out += start + csv_field(name) + "," + shortest_number(value) + "\n";
  }
  return out;
}

}  // namespace semfield
