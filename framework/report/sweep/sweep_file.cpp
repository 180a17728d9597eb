#include "report/sweep/sweep_file.h"

#include <algorithm>
#include <charconv>
#include <filesystem>
#include <set>

#include "config/params_read.h"
#include "config/shipped_config.h"

namespace semfield {

namespace {

constexpr std::size_t kMostVariants = 10'000;

const std::vector<std::string> kExperimentKeys{"name",       "title",   "note",     "split", "metrics",
                                               "paper",      "x_label", "base",     "set",   "scenes",
                                               "use_scenes", "seeds",   "variants", "grid"};

class Reader {
 public:
  explicit Reader(Diagnostics& diagnostics) : diagnostics_(diagnostics) {}

  Experiment experiment(const ConfigNode& tree, const std::string& fallback_name) {
    Experiment e;
    known_keys(tree, "", kExperimentKeys);
    e.name = read_text(tree, "", "name", fallback_name, diagnostics_);
    if (e.name.find('/') != std::string::npos)
      error(*tree.find("name"), "name: '" + e.name + "': files are named after it, so it cannot hold '/'");
    e.title = read_text(tree, "", "title", e.name, diagnostics_);
    e.note = read_text(tree, "", "note", "", diagnostics_);
    e.paper = read_text(tree, "", "paper", "", diagnostics_);
    e.x_label = read_text(tree, "", "x_label", "", diagnostics_);
    e.split = read_text(tree, "", "split", "test", diagnostics_);
    if (e.split != "test" && e.split != "train") error(*tree.find("split"), "split: expected test or train");
    e.metrics = texts(tree, "metrics");
    if (e.metrics.empty()) e.metrics = {"miou_present", "total_accuracy"};
    e.set = overrides(tree.find("set"), "set");
    e.seeds = seeds(tree);
    scenes(tree, e);
    variants(tree, e);
    return e;
  }

 private:
  void error(const ConfigNode& node, const std::string& message, const std::string& remedy = {}) {
    diagnostics_.error("sweep.file.value", node.location().text(), message, remedy);
  }

  void known_keys(const ConfigNode& node, const std::string& path, const std::vector<std::string>& known) {
    for (const auto& [key, value] : node.entries()) {
      if (std::find(known.begin(), known.end(), key) != known.end()) continue;
      const std::string near = did_you_mean(key, known);
      diagnostics_.error("config.key.unknown", value.key_location().text(),
                         (path.empty() ? "" : path + ": ") + "unknown key '" + key + "'",
                         near.empty() ? "known: " + join(known) : "did you mean '" + near + "'?");
    }
  }

  std::vector<std::string> texts(const ConfigNode& tree, const std::string& key) {
    std::vector<std::string> out;
    const ConfigNode* node = tree.find(key);
    if (node == nullptr || node->is_null()) return out;
    if (!node->is_list()) error(*node, key + ": expected a list");
    for (const ConfigNode& item : node->items()) {
      if (!item.is_scalar()) error(item, key + ": expected a list of words");
      out.push_back(item.text());
    }
    return out;
  }

  std::optional<double> number(const ConfigNode& map, const std::string& path, const std::string& key) {
    const ConfigNode* node = map.find(key);
    if (node == nullptr || node->is_null()) return std::nullopt;
    double value = 0;
    const char* end = node->text().data() + node->text().size();
    const auto read = std::from_chars(node->text().data(), end, value);
    if (!node->is_scalar() || read.ec != std::errc{} || read.ptr != end) {
      error(*node, path + "." + key + ": expected a number");
      return std::nullopt;
    }
    return value;
  }

  bool flag(const ConfigNode& map, const std::string& path, const std::string& key) {
    const ConfigNode* node = map.find(key);
    if (node == nullptr || node->is_null()) return false;
    if (node->text() != "true" && node->text() != "false") error(*node, path + "." + key + ": expected true or false");
    return node->text() == "true";
  }

  std::string base_file(const ConfigNode& node) {
    const std::string path = resolve_path(node);
    std::error_code ignored;
    if (std::filesystem::is_regular_file(path, ignored)) return path;
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

  std::vector<std::int64_t> seeds(const ConfigNode& tree) {
    std::vector<std::int64_t> out;
    const ConfigNode* node = tree.find("seeds");
    if (node == nullptr || node->is_null()) return {1};
    for (const ConfigNode& item : node->items()) {
      std::int64_t seed = -1;
      const char* end = item.text().data() + item.text().size();
      const auto read = std::from_chars(item.text().data(), end, seed);
      if (read.ec != std::errc{} || read.ptr != end || seed < 0 || seed > 0xFFFFFFFFLL)
        error(item, "seeds: expected whole numbers from 0 to 4294967295, got '" + item.text() + "'");
      if (std::find(out.begin(), out.end(), seed) != out.end()) error(item, "seeds: " + item.text() + " stands twice");
      out.push_back(seed);
    }
    if (out.empty()) error(*node, "seeds: expected a list of at least one whole number");
    return out;
  }

  void scenes(const ConfigNode& tree, Experiment& e) {
    const ConfigNode* base = tree.find("base");
    const ConfigNode* map = tree.find("scenes");
    if (map == nullptr && base != nullptr && base->is_scalar() && tree.find("use_scenes") == nullptr) {
      SweepScene own;  // the base's
      own.base = base_file(*base);
      own.name = std::filesystem::path(own.base).stem().string();
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
    const std::vector<std::string> use = texts(tree, "use_scenes");
    for (const std::string& name : use) {
      if (std::find(names.begin(), names.end(), name) == names.end())
        error(*tree.find("use_scenes"), "use_scenes: no scene '" + name + "'; known: " + join(names));
    }
    for (const auto& [name, node] : map->entries()) {
      if (!use.empty() && std::find(use.begin(), use.end(), name) == use.end()) continue;
      const std::string path = "scenes." + name;
      SweepScene scene;
      scene.name = name;
      if (node.is_map()) known_keys(node, path, {"base", "set", "after", "pack"});
      const ConfigNode* own = node.is_map() ? node.find("base") : nullptr;
      const ConfigNode* file = own != nullptr ? own : base;
      if (file == nullptr || !file->is_scalar()) {
        error(node, path + ": no base configuration", "write base: FILE for the scene or for all");
        continue;
      }
      scene.base = base_file(*file);
      scene.set = overrides(node.is_map() ? node.find("set") : nullptr, path + ".set");
      scene.after = overrides(node.is_map() ? node.find("after") : nullptr, path + ".after");
      scene.pack = flag(node, path, "pack");
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
      if (!node.is_map() && !node.is_null())
        error(node, path + ": expected a map {base, set, x, paper, fuse, objects}");
      known_keys(node, path, {"base", "set", "x", "paper", "fuse", "objects"});
      if (const ConfigNode* file = node.find("base"); file != nullptr) v.base = base_file(*file);
      v.set = overrides(node.find("set"), path + ".set");
      v.x = number(node, path, "x");
      v.paper = number(node, path, "paper");
      if (const ConfigNode* fuse = node.find("fuse"); fuse != nullptr) {
        known_keys(*fuse, path + ".fuse", {"method", "field"});
        FuseCell cell;
        cell.method = read_text(*fuse, path + ".fuse", "method", "", diagnostics_);
        cell.field = read_text(*fuse, path + ".fuse", "field", "", diagnostics_);
        static const std::set<std::string> methods{"monocular", "bayesian", "average"};
        if (!methods.contains(cell.method))
          error(*fuse, path + ".fuse.method: expected monocular, bayesian or average, got '" + cell.method + "'");
        if (!cell.field.empty()) check_field(*map, *fuse, path + ".fuse.field", cell.field);
        v.fuse = std::move(cell);
      }
      if (const ConfigNode* objects = node.find("objects"); objects != nullptr) {
        v.objects = read_text(node, path, "objects", "", diagnostics_);
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
          if (grid.entries().size() == 1 && value.is_scalar()) {
            double x = 0;
            const char* end = value.text().data() + value.text().size();
            const auto read = std::from_chars(value.text().data(), end, x);
            if (read.ec == std::errc{} && read.ptr == end) v.x = x;
          }
          next.push_back(std::move(v));
        }
      }
      rows = std::move(next);
    }
    e.variants = std::move(rows);
  }

  Diagnostics& diagnostics_;
};

std::string stem_of(const std::string& path) { return std::filesystem::path(path).stem().string(); }

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

}  // namespace semfield
