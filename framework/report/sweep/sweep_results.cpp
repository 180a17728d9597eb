#include "report/sweep/sweep_results.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <tuple>

#include "config/params.h"
#include "core/check.h"
#include "core/error.h"
#include "core/view.h"
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

namespace {

// Upper tail P(T > t) of Student's t by its finite series in theta = atan(t / sqrt(v)) [Abramowitz64, 26.7.3-26.7.4].
double t_upper_tail(double t, int v) {
  const double theta = std::atan(t / std::sqrt(static_cast<double>(v)));
  const double s = std::sin(theta), c = std::cos(theta);
  double term = v % 2 == 1 ? c : 1, sum = v == 1 ? 0 : term;
  for (int k = v % 2 == 1 ? 3 : 2; k <= v - 2; k += 2) {
    term *= c * c * (k - 1) / k;
    sum += term;
  }
  const double inside = v % 2 == 1 ? 2 / M_PI * (theta + s * sum) : s * sum;  // P(-t < T < t)
  return (1 - inside) / 2;
}

std::string cell_text(const MeanInterval& m) {
  if (m.n == 0) return "–";
  if (m.half_width > 0) return fmt::format("{:.3f} ± {:.3f}", m.mean, m.half_width);
  return fmt::format("{:.3f}", m.mean);
}

// What a reader calls a metric of metrics.jsonl.
std::string metric_label(const std::string& metric) {
  static const std::map<std::string, std::string> labels{
      {"miou_present", "mIoU"},
      {"given_miou_present", "mIoU of the labels given"},
      {"total_accuracy", "accuracy"},
      {"given_total_accuracy", "accuracy of the labels given"},
      {"psnr", "PSNR, dB"},
      {"absrel", "AbsRel"},
      {"ece", "ECE"},
      {"nll", "NLL, nats"},
      {"entropy_auroc", "AUROC of entropy, wrong pixels"},
      {"training_miou_present", "mIoU of training frames"},
      {"training_ece", "ECE of training frames"},
      {"training_entropy_auroc", "AUROC of entropy, wrong pixels of training frames"},
      {"given_right_entropy", "entropy where labelled rightly, nats"},
      {"given_wrong_entropy", "entropy where labelled wrongly, nats"},
      {"given_none_entropy", "entropy where unlabelled, nats"},
      {"given_wrong_auroc", "AUROC of entropy, wrong against right labels"},
      {"given_none_auroc", "AUROC of entropy, unlabelled against labelled"},
      {"rmse", "RMSE of depth, m"},
      {"train_s", "seconds of training"},
      {"processor_s", "CPU seconds"},
      {"peak_mb", "peak memory, MB"}};
  const auto found = labels.find(metric);
  return found == labels.end() ? metric : found->second;
}

// A line of a table in Markdown; a bar would end the cell.
std::string md_line(const std::vector<std::string>& cells) {
  std::string out = "|";
  for (const std::string& cell : cells) {
    out += ' ';
    for (const char c : cell) out += c == '|' ? "\\|" : std::string(1, c);
    out += " |";
  }
  return out + "\n";
}

}  // namespace

double student_t975(int freedom) {
  SEMFIELD_CHECK(freedom >= 1, "no degrees of freedom");
  double low = 1.9, high = 12.8;  // t(1) = 12.7062, t(infinity) = 1.9600
  for (int i = 0; i < 60; ++i) {
    const double middle = (low + high) / 2;
    (t_upper_tail(middle, freedom) > 0.025 ? low : high) = middle;
  }
  return (low + high) / 2;
}

MeanInterval mean_interval(const std::vector<double>& values) {
  MeanInterval out;
  out.n = static_cast<int>(values.size());
  if (values.empty()) return out;
  for (const double v : values) out.mean += v;
  out.mean /= out.n;
  if (out.n < 2) return out;
  double squares = 0;
  for (const double v : values) squares += (v - out.mean) * (v - out.mean);
  out.half_width = student_t975(out.n - 1) * std::sqrt(squares / (out.n - 1) / out.n);
  return out;
}

ExperimentTable::ExperimentTable(const Sweep& sweep, std::size_t experiment, const std::vector<Cell>& cells,
                                 const SweepResults& results)
    : experiment_(sweep.experiments.at(experiment)) {
  scored_.resize(experiment_.scenes.size());
  values_.assign(experiment_.scenes.size(), std::vector<std::vector<const CellValues*>>(experiment_.variants.size()));
  for (const Cell& cell : cells) {
    const auto found = results.find(cell.id);
    if (found == results.end()) continue;
    for (const CellUse& use : cell.uses) {
      if (use.experiment != experiment) continue;
      values_[use.scene][use.variant].push_back(&found->second);
      if (cell.trains()) note_unequal(use, found->second);
    }
  }
}

void ExperimentTable::note_unequal(const CellUse& use, const CellValues& values) {
  for (const char* what : {"frames", "pixels"}) {
    const auto is = [&](const auto& entry) { return entry.first == what; };
    const auto own = std::find_if(values.begin(), values.end(), is);
    if (own == values.end()) continue;  // of versions that did not write it
    CellValues& first = scored_[use.scene];
    const auto others = std::find_if(first.begin(), first.end(), is);
    if (others == first.end()) {
      first.push_back(*own);
    } else if (others->second != own->second && unequal_.empty()) {
      unequal_ = fmt::format("its variants were scored on other {} of the scene '{}': {:.0f}, and {:.0f} by '{}'", what,
                             experiment_.scenes[use.scene].name, others->second, own->second,
                             experiment_.variants[use.variant].name);
    }
  }
}

MeanInterval ExperimentTable::at(std::size_t scene, std::size_t variant, const std::string& metric) const {
  std::vector<double> values;
  for (const CellValues* seed : values_[scene][variant]) {
    for (const auto& [name, value] : *seed) {
      if (name == metric) values.push_back(value);
    }
  }
  return mean_interval(values);
}

MeanInterval ExperimentTable::over_scenes(std::size_t variant, const std::string& metric) const {
  MeanInterval out;
  double squares = 0;
  bool known = true;  // of every scene's interval
  for (std::size_t s = 0; s < values_.size(); ++s) {
    const MeanInterval m = at(s, variant, metric);
    if (m.n == 0) continue;
    ++out.n;
    out.mean += m.mean;
    squares += m.half_width * m.half_width;
    known = known && m.n > 1;
  }
  if (out.n > 0) {
    out.mean /= out.n;
    if (known) out.half_width = std::sqrt(squares) / out.n;
  }
  return out;
}

std::vector<std::vector<std::string>> ExperimentTable::rows_of(const std::string& metric, bool with_paper) const {
  const Experiment& e = experiment_;
  const bool many = e.scenes.size() > 1;
  std::vector<std::vector<std::string>> rows{{metric_label(metric)}};
  for (const SweepScene& scene : e.scenes) rows[0].push_back(scene.name);
  if (many) rows[0].push_back("mean");
  if (with_paper) rows[0].push_back("paper" + (e.paper.empty() ? "" : " (" + e.paper + ")"));
  for (std::size_t v = 0; v < e.variants.size(); ++v) {
    std::vector<std::string>& row = rows.emplace_back(1, e.variants[v].name);
    for (std::size_t s = 0; s < e.scenes.size(); ++s) row.push_back(cell_text(at(s, v, metric)));
    if (many) row.push_back(cell_text(over_scenes(v, metric)));
    if (with_paper) row.push_back(e.variants[v].paper ? fmt::format("{:.3f}", *e.variants[v].paper) : "–");
  }
  return rows;
}

std::vector<std::vector<std::vector<std::string>>> ExperimentTable::tables() const {
  const std::vector<SweepVariant>& variants = experiment_.variants;
  bool paper = std::any_of(variants.begin(), variants.end(), [](const SweepVariant& v) { return v.paper.has_value(); });
  std::vector<std::vector<std::vector<std::string>>> out;
  for (const std::string& metric : unequal_.empty() ? experiment_.metrics : std::vector<std::string>()) {
    out.push_back(rows_of(metric, paper));
    paper = false;  // its figures are of the first metric
  }
  return out;
}

std::string ExperimentTable::scored_text() const {
  const std::size_t seeds = experiment_.seeds.size();
  return fmt::format("Scored on {} frames; {}.", experiment_.split == "train" ? "training" : "held-out",
                     seeds == 1 ? "one seed" : fmt::format("mean of {} seeds ± half the 95 % interval", seeds));
}

std::string ExperimentTable::markdown() const {
  const Experiment& e = experiment_;
  std::string out = "## " + e.title + "\n\n" + (e.note.empty() ? "" : e.note + "\n\n") + scored_text() + "\n";
  if (!unequal_.empty()) out += "\nNot compared: " + unequal_ + ".\n";
  for (const auto& rows : tables()) {
    out += "\n" + md_line(rows[0]) + "|";
    for (std::size_t i = 0; i < rows[0].size(); ++i) out += "---|";
    out += "\n";
    for (std::size_t i = 1; i < rows.size(); ++i) out += md_line(rows[i]);
  }
  return out;
}

std::string ExperimentTable::csv() const {
  const Experiment& e = experiment_;
  std::string out = "variant,scene,metric,n,mean,half_width\n";
  if (!unequal_.empty()) return out;
  for (std::size_t v = 0; v < e.variants.size(); ++v) {
    for (std::size_t s = 0; s < e.scenes.size(); ++s) {
      for (const std::string& metric : e.metrics) {
        const MeanInterval m = at(s, v, metric);
        if (m.n == 0) continue;
        out += csv_field(e.variants[v].name) + "," + csv_field(e.scenes[s].name) + "," + csv_field(metric) + "," +
               std::to_string(m.n) + "," + shortest_number(m.mean) + "," + shortest_number(m.half_width) + "\n";
      }
    }
  }
  return out;
}

std::string ExperimentTable::json() const {
  const Experiment& e = experiment_;
  Json series = Json::array();
  std::size_t places = 0;
  for (std::size_t s = 0; s < e.scenes.size() && unequal_.empty(); ++s) {
    std::multimap<double, Json> points;
    for (std::size_t v = 0; v < e.variants.size(); ++v) {
      const MeanInterval m = at(s, v, e.metrics.front());
      if (!e.variants[v].x || m.n == 0) continue;
      Json point{{"x", *e.variants[v].x}, {"y", m.mean}};
      if (m.half_width > 0) point.update({{"low", m.mean - m.half_width}, {"high", m.mean + m.half_width}});
      points.emplace(*e.variants[v].x, std::move(point));
    }
    places = std::max(places, points.size());
    Json line{{"name", e.scenes[s].name}, {"color", s}, {"points", Json::array()}};
    for (auto& [x, point] : points) line["points"].push_back(std::move(point));
    series.push_back(std::move(line));
  }
  Json plot;
  if (places > 1)
    plot = {{"title", metric_label(e.metrics.front())}, {"x_label", e.x_label}, {"series", std::move(series)}};
  return Json{{"name", e.name},      {"title", e.title},   {"note", e.note}, {"scored", scored_text()},
              {"unequal", unequal_}, {"tables", tables()}, {"plot", plot}}
      .dump(-1, ' ', false, Json::error_handler_t::replace);
}

int cells_at_a_time(int own, int cores, int processes, int threads) {
  const int share = std::max(1, std::min(own, cores / std::max(1, processes)));
  return std::max(1, share / std::max(1, threads));
}

std::vector<std::string> devices_of_process(const std::vector<std::string>& devices, int rank, int size) {
  std::vector<std::string> own;
  for (std::size_t i = static_cast<std::size_t>(rank); i < devices.size(); i += static_cast<std::size_t>(size))
    own.push_back(devices[i]);
  return own;
}

std::string free_device(const std::vector<std::string>& devices, const std::vector<std::string>& busy) {
  const auto is_free = [&](const std::string& device) {
    return std::find(busy.begin(), busy.end(), device) == busy.end();
  };
  const auto found = std::find_if(devices.begin(), devices.end(), is_free);
  return found == devices.end() ? "" : *found;
}

std::vector<std::string> device_names(const std::vector<std::string>& words) {
  std::vector<std::string> names;
  for (const std::string& word : words) {
    const std::optional<DeviceId> id = device_of(word.starts_with("cuda") ? word : "cuda:" + word);
    if (!id || word == "cuda")
      throw Error(ErrorKind::usage, "usage.value.devices", "--devices: '" + word + "' is not a CUDA device",
                  "write all, or numbers with commas between them: 0,1");
    const std::string name = "cuda:" + std::to_string(id->ordinal);
    if (std::find(names.begin(), names.end(), name) != names.end())
      throw Error(ErrorKind::usage, "usage.value.devices", "--devices: '" + word + "' is named twice",
                  "name every device once");
    names.push_back(name);
  }
  return names;
}

}  // namespace semfield
