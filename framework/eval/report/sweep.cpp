#include "eval/report/sweep.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>
#include <set>
#include <span>

#include "config/params.h"
#include "config/settings/run_config.h"
#include "core/check.h"
#include "core/checksum.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "core/view.h"
#include "formats/text_rows.h"
#include "train/metrics_log.h"

namespace semfield {

namespace {

constexpr std::size_t kMostVariants = 10'000;
constexpr std::array<std::string_view, 2> kSplits{"test", "train"};
constexpr std::array<std::string_view, 3> kFusions{"monocular", "bayesian", "average"};

// What is read of a map: parameters, and below them the keys that are none.

void describe_word(ParamVisitor& visit, const ParamInfo& info, std::string& value,
                   std::span<const std::string_view> names) {
  const auto found = std::find(names.begin(), names.end(), value);
  ChosenName choice{found == names.end() ? 0 : static_cast<int>(found - names.begin()), names};
  visit(info, &choice);
  value = names[static_cast<std::size_t>(choice.index)];
}

void describe_number(ParamVisitor& visit, const ParamInfo& info, std::optional<double>& value) {
  double number = value.value_or(0);
  visit(info, &number);
  value = number;
}

Describe keys_of(Experiment& e) {
  return [&e](ParamVisitor& visit) {
    SEMFIELD_PARAM(visit, e, name, "of the experiment, its folder and files; default: the file's name");
    SEMFIELD_PARAM(visit, e, title, "of table and plot");
    SEMFIELD_PARAM(visit, e, note, "sentences above the table");
    describe_word(visit, {"split", "whose frames are scored; default: test"}, e.split, kSplits);
    SEMFIELD_PARAM(visit, e, metrics,
                   "columns, by their names in metrics.jsonl, training_... and given_... of training frames; the first "
                   "is plotted");
    SEMFIELD_PARAM(visit, e, paper, "what the paper's figures are");
    SEMFIELD_PARAM(visit, e, x_label, "of the plot");
    SEMFIELD_PARAM(visit, e, use_scenes, "only these of them");
    SEMFIELD_PARAM(visit, e, seeds, "each goes to runtime.seed and scene.labels.seed", {0, 4294967295.0});
  };
}
Describe keys_of(SweepVariant& v) {
  return [&v](ParamVisitor& visit) {
    describe_number(visit, {"x", "abscissa of the plot"}, v.x);
    describe_number(visit, {"paper", "the paper's figure"}, v.paper);
    SEMFIELD_PARAM(visit, v, objects, "variant in whose run objects are found instead of training");
  };
}
Describe keys_of(FuseCell& fuse) {
  return [&fuse](ParamVisitor& visit) {
    describe_word(visit, {"method", "how views are combined"}, fuse.method, kFusions);
    SEMFIELD_PARAM(visit, fuse, field, "variant whose field gives the depth; else the true depth");
  };
}

bool is_given(const ConfigNode& map, std::string_view key) {
  const ConfigNode* node = map.find(key);
  return node != nullptr && !node->is_null();
}

class Reader {
 public:
  explicit Reader(Diagnostics& diagnostics) : diagnostics_(diagnostics) {}

  Experiment experiment(const ConfigNode& tree, const std::string& fallback_name) {
    Experiment e;
    e.name = fallback_name;
    e.seeds = {1};
    read(tree, "", keys_of(e), {"base", "set", "scenes", "variants", "grid"});
    if (e.name.find('/') != std::string::npos)
      error(*tree.find("name"), "name: '" + e.name + "': files are named after it, so it cannot hold '/'");
    if (!is_given(tree, "title")) e.title = e.name;
    if (e.metrics.empty()) e.metrics = {"miou_present", "total_accuracy"};
    if (e.seeds.empty()) error(*tree.find("seeds"), "seeds: expected a list of at least one whole number");
    for (auto seed = e.seeds.begin(); seed != e.seeds.end(); ++seed)
      if (std::find(e.seeds.begin(), seed, *seed) != seed)
        error(tree.find("seeds")->items()[static_cast<std::size_t>(seed - e.seeds.begin())],
              "seeds: " + std::to_string(*seed) + " stands twice");
    e.set = overrides(tree.find("set"), "set");
    scenes(tree, e);
    variants(tree, e);
    return e;
  }

 private:
  void error(const ConfigNode& node, const std::string& message, const std::string& remedy = {}) {
    diagnostics_.error("sweep.file.value", node.location().text(), message, remedy);
  }

  // A key without a value is one that is not there.
  void read(const ConfigNode& map, const std::string& path, const Describe& keys,
            const std::vector<std::string>& other_keys) {
    ConfigNode given = map;
    for (const ParamDoc& key : describe_params(keys))
      if (map.find(key.name) != nullptr && !is_given(map, key.name)) given = given.without(key.name);
    read_params(given, path, keys, diagnostics_, other_keys);
  }

  std::string base_file(const ConfigNode& node) {
    const std::string path = resolve_path(node);
    if (is_file(path)) return path;
    const std::string place = shipped_place(node.text()), shipped = shipped_config(node.text());
    if (shipped.empty())
      error(node, "base: no file '" + path + "'" + (place.empty() ? "" : ", and none '" + place + "'"),
            "paths are relative to the file that writes them");
    return shipped;
  }

  std::vector<ConfigOverride> overrides(const ConfigNode* node, const std::string& path) {
    std::vector<ConfigOverride> out;
    if (node == nullptr || node->is_null()) return out;
    if (!node->is_map()) error(*node, path + ": expected a map of key paths, such as {train.steps: 500}");
    for (const auto& [key, value] : node->entries()) out.push_back({key, value});
    return out;
  }

  void scenes(const ConfigNode& tree, Experiment& e) {
    const ConfigNode* base = tree.find("base");
    const ConfigNode* map = tree.find("scenes");
    if (map == nullptr && base != nullptr && base->is_scalar() && tree.find("use_scenes") == nullptr) {
      SweepScene own;  // the base's
      own.base = base_file(*base);
      own.name = fs::path(own.base).stem().string();
      e.scenes.push_back(std::move(own));
      return;
    }
    if (map == nullptr || !map->is_map() || map->entries().empty()) {
      error(map == nullptr ? tree : *map, "scenes: expected a map of at least one scene {base, set}",
            "write one, or base: FILE alone, whose own scene is taken then");
      return;
    }
    std::vector<std::string> names;
    for (const auto& entry : map->entries()) names.push_back(entry.first);
    const std::vector<std::string>& use = e.use_scenes;
    for (const std::string& name : use) {
      if (std::find(names.begin(), names.end(), name) == names.end())
        error(*tree.find("use_scenes"), "use_scenes: no scene '" + name + "'; known: " + join(names));
    }
    for (const auto& [name, node] : map->entries()) {
      if (!use.empty() && std::find(use.begin(), use.end(), name) == use.end()) continue;
      const std::string path = "scenes." + name;
      SweepScene scene;
      scene.name = name;
      read(node, path, [](ParamVisitor&) {}, {"base", "set", "after"});
      const ConfigNode* own = node.find("base");
      const ConfigNode* file = own != nullptr ? own : base;
      if (file == nullptr || !file->is_scalar()) {
        error(node, path + ": no base configuration", "write base: FILE for the scene or for all");
        continue;
      }
      scene.base = base_file(*file);
      scene.set = overrides(node.find("set"), path + ".set");
      scene.after = overrides(node.find("after"), path + ".after");
      e.scenes.push_back(std::move(scene));
    }
  }

  void variants(const ConfigNode& tree, Experiment& e) {
    const ConfigNode* map = tree.find("variants");
    const ConfigNode* grid = tree.find("grid");
    if ((map == nullptr) == (grid == nullptr)) {
      error(tree, "expected either 'variants' (a map of named differences) or 'grid' (lists of values by key path)");
      return;
    }
    if (grid != nullptr) {
      grid_variants(*grid, e);
      return;
    }
    if (!map->is_map() || map->entries().empty()) error(*map, "variants: expected a map of at least one variant");
    for (const auto& [name, node] : map->entries()) {
      const std::string path = "variants." + name;
      SweepVariant v;
      v.name = name;
      read(node, path, keys_of(v), {"base", "set", "fuse"});
      if (!is_given(node, "x")) v.x.reset();
      if (!is_given(node, "paper")) v.paper.reset();
      if (const ConfigNode* file = node.find("base"); file != nullptr) v.base = base_file(*file);
      v.set = overrides(node.find("set"), path + ".set");
      if (const ConfigNode* fuse = node.find("fuse"); fuse != nullptr) {
        FuseCell& cell = v.fuse.emplace();
        read(*fuse, path + ".fuse", keys_of(cell), {});
        if (!is_given(*fuse, "method"))
          error(*fuse, path + ".fuse.method: expected monocular, bayesian or average, got nothing");
        if (!cell.field.empty()) check_field(*map, *fuse, path + ".fuse.field", cell.field);
      }
      if (const ConfigNode* objects = node.find("objects"); objects != nullptr) {
        if (v.fuse) error(*objects, path + ": a row is of 'fuse' or of 'objects'", "make two rows of it");
        check_field(*map, *objects, path + ".objects", v.objects);
      }
      e.variants.push_back(std::move(v));
    }
  }

  void check_field(const ConfigNode& variants, const ConfigNode& place, const std::string& path,
                   const std::string& name) {
    const ConfigNode* field = variants.find(name);
    if (field == nullptr || field->find("fuse") != nullptr || field->find("objects") != nullptr)
      error(place, path + ": no variant '" + name + "' that trains a field");
  }

  // Every combination of the lists' values, the last key fastest.
  void grid_variants(const ConfigNode& grid, Experiment& e) {
    if (!grid.is_map() || grid.entries().empty()) error(grid, "grid: expected a map of key paths to lists of values");
    std::vector<SweepVariant> rows{SweepVariant{}};
    for (const auto& [key, values] : grid.entries()) {
      if (!values.is_list() || values.items().empty()) {
        error(values, "grid." + key + ": expected a list of at least one value");
        continue;
      }
      if (rows.size() * values.items().size() > kMostVariants) {
        error(grid, "grid: more than " + std::to_string(kMostVariants) + " combinations",
              "split it into several sweeps");
        return;
      }
      std::vector<SweepVariant> next;
      for (const SweepVariant& row : rows) {
        for (const ConfigNode& value : values.items()) {
          SweepVariant v = row;
          v.name += (v.name.empty() ? "" : ", ") + key.substr(key.rfind('.') + 1) + " " + write_config_inline(value);
          v.set.push_back({key, value});
          if (grid.entries().size() == 1 && value.is_scalar())
            if (const auto x = to_number<double>(value.text())) v.x = x;
          next.push_back(std::move(v));
        }
      }
      rows = std::move(next);
    }
    e.variants = std::move(rows);
  }

  Diagnostics& diagnostics_;
};

std::string stem_of(const std::string& path) { return fs::path(path).stem().string(); }

}  // namespace

bool Experiment::wants_training_frames() const {
  return std::any_of(metrics.begin(), metrics.end(), [](const std::string& metric) {
    return metric.starts_with(kTrainingPrefix) || metric.starts_with(kGivenPrefix);
  });
}

Sweep read_sweep(const std::string& path) {
  const ConfigNode root = compose_config(path);
  Sweep sweep;
  Diagnostics diagnostics;
  sweep.name = read_text(root, "", "name", stem_of(path), diagnostics);
  Reader reader(diagnostics);
  if (const ConfigNode* list = root.find("sweeps"); list != nullptr) {
    if (!list->is_list())
      diagnostics.error("sweep.file.value", list->location().text(), "sweeps: expected a list of files", {});
    const ConfigNode over = root.without("sweeps").without("name");
    for (const ConfigNode& item : list->items()) {
      const std::string file = resolve_path(item);
      sweep.experiments.push_back(reader.experiment(merge_config(compose_config(file), over), stem_of(file)));
    }
  } else {
    sweep.experiments.push_back(reader.experiment(root, stem_of(path)));
  }
  std::set<std::string> names;
  for (const Experiment& e : sweep.experiments) {
    if (!names.insert(e.name).second)
      diagnostics.error("sweep.name.twice", path, "two experiments are called '" + e.name + "'", {});
  }
  diagnostics.throw_if_errors(ErrorKind::config, "");
  return sweep;
}

using Json = nlohmann::ordered_json;

namespace {

// The resolved configuration of one cell; errors go into `diagnostics`, each once.
std::string resolve(const Experiment& e, const CellUse& use, Registry& registry, std::set<std::string>& told,
                    Diagnostics& diagnostics) {
  const SweepScene& scene = e.scenes[use.scene];
  const SweepVariant& variant = e.variants[use.variant];
  std::vector<ConfigOverride> set = scene.set;
  set.insert(set.end(), e.set.begin(), e.set.end());
  set.insert(set.end(), variant.set.begin(), variant.set.end());
  set.insert(set.end(), scene.after.begin(), scene.after.end());
  Diagnostics found;
  std::string text;
  const std::string& base = variant.base.empty() ? scene.base : variant.base;
  noting(found, "", [&] {
    RunConfig config = read_run_config(compose_config_with(base, set), registry, found);
    config.name = scene.name;
    // Not the working folder: from wherever a sweep is started, its cells are the same.
    config.base_dir = fs::path(base).parent_path().string();
    config.runtime.seed = static_cast<std::uint32_t>(e.seeds[use.seed]);
    config.labels.selection.seed = e.seeds[use.seed];
    if (!variant.objects.empty()) config.objects.seed = static_cast<std::uint32_t>(e.seeds[use.seed]);
    config.report.eval_share = 0;  // cells are compared, so each scores every frame however long it takes
    // As many as the configuration says, else all; experiments without a figure of training frames need none.
    const bool training = e.split == "train" || e.wants_training_frames();
    if (!training) config.report.training_frames = 0;
    if (training && config.report.training_frames == 0) config.report.training_frames = 1000000;
    if (!found.has_errors()) text = write_config(resolved_config(config));
  });
  for (const Diagnostic& finding : found.all()) {
    if (finding.severity != Severity::error || !told.insert(finding.text()).second) continue;
    const std::string where = e.name + " / " + scene.name + " / " + variant.name;
    diagnostics.error(finding.code, finding.where, finding.message + " (" + where + ")", finding.remedy);
  }
  return text;
}

// Limits of inputs change no result, so they are no part of what a cell is.
std::string identity_of(const std::string& config) {
  return write_config(parse_config_text(config, "cell").without("limits"));
}

}  // namespace

std::string id_of_cell(const Cell& cell) {
  return hex64(
      fnv1a64(identity_of(cell.config) + "\n" + cell.split + "\n" + cell.fuse.method + "\n" + cell.field_cell));
}

std::vector<Cell> plan_cells(const Sweep& sweep, Registry& registry) {
  std::vector<Cell> cells;
  std::map<std::string, std::size_t> known;
  std::set<std::string> told;
  Diagnostics diagnostics;
  for (std::size_t x = 0; x < sweep.experiments.size(); ++x) {
    const Experiment& e = sweep.experiments[x];
    for (std::size_t s = 0; s < e.scenes.size(); ++s) {
      for (std::size_t seed = 0; seed < e.seeds.size(); ++seed) {
        std::map<std::string, std::string> id_of_variant;
        // Fields before the fusions that take their depth, and the objects found in them.
        for (const bool trains : {true, false}) {
          for (std::size_t v = 0; v < e.variants.size(); ++v) {
            const SweepVariant& variant = e.variants[v];
            if (variant.trains() != trains) continue;
            const CellUse use{x, s, v, seed};
            Cell cell;
            cell.config = resolve(e, use, registry, told, diagnostics);
            if (cell.config.empty()) continue;
            cell.split = e.split;
            cell.scene = e.scenes[s].name;
            cell.label = e.name + " / " + variant.name;
            cell.seed = e.seeds[seed];
            if (variant.fuse) {
              cell.fuse = *variant.fuse;
              cell.field_cell = id_of_variant[variant.fuse->field];
            }
            if (!variant.objects.empty()) {
              cell.objects = true;
              cell.field_cell = id_of_variant[variant.objects];
            }
            cell.id = id_of_cell(cell);
            id_of_variant[variant.name] = cell.id;
            const auto [place, is_new] = known.emplace(cell.id, cells.size());
            if (is_new) cells.push_back(std::move(cell));
            cells[place->second].uses.push_back(use);
          }
        }
      }
    }
  }
  diagnostics.throw_if_errors(ErrorKind::config, "the sweep's configurations have errors:");
  return cells;
}

namespace {

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
  if (!fs::exists(path)) return std::nullopt;
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
  const Json root = parse(json, "result of semfield labels fuse");
  for (const Json& row : root.is_object() ? root.value("scores", Json::array()) : Json::array()) {
    if (row.is_object() && row.value("method", "") == method) return numbers_of(row);
  }
  throw Error(ErrorKind::data, "sweep.result.missing",
              "semfield labels fuse gave no result for the method '" + method + "'");
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

std::string use_csv(const Sweep& sweep, const CellUse& use) {
  const Experiment& e = sweep.experiments[use.experiment];
  return csv_field(e.name) + "," + csv_field(e.scenes[use.scene].name) + "," + csv_field(e.variants[use.variant].name) +
         "," + std::to_string(e.seeds[use.seed]);
}

std::string results_csv(const Sweep& sweep, const std::vector<Cell>& cells, const SweepResults& results) {
  std::map<CellUse, const CellValues*> lines;
  for (const Cell& cell : cells)
    if (const auto found = results.find(cell.id); found != results.end())
      for (const CellUse& use : cell.uses) lines[use] = &found->second;
  std::string out = "experiment,scene,variant,seed,metric,value\n";
  for (const auto& [use, values] : lines)
    for (const auto& [name, value] : *values)
      out += use_csv(sweep, use) + "," + csv_field(name) + "," + shortest_number(value) + "\n";
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

std::string markdown_table(const std::vector<std::vector<std::string>>& rows) {
  std::string out = md_line(rows[0]) + "|";
  for (std::size_t i = 0; i < rows[0].size(); ++i) out += "---|";
  out += "\n";
  for (std::size_t i = 1; i < rows.size(); ++i) out += md_line(rows[i]);
  return out;
}

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
  for (const auto& rows : tables()) out += "\n" + markdown_table(rows);
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
