#include "report/sweep/sweep_cells.h"

#include <algorithm>
#include <filesystem>
#include <map>
#include <set>

#include "session/settings/run_config.h"
#include "system/checksum.h"

namespace semfield {

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
  try {
    RunConfig config = read_run_config(compose_config_with(base, set), registry, found);
    config.name = scene.name;
    // Not the working folder: from wherever a sweep is started, its cells are the same.
    config.base_dir = std::filesystem::path(base).parent_path().string();
    config.runtime.seed = static_cast<std::uint32_t>(e.seeds[use.seed]);
    config.labels.selection.seed = e.seeds[use.seed];
    if (!variant.objects.empty()) config.objects.seed = static_cast<std::uint32_t>(e.seeds[use.seed]);
    config.report.eval_share = 0;  // cells are compared, so each scores every frame however long it takes
    // As many as the configuration says, else all; experiments without a figure of training frames need none.
    const bool training = e.split == "train" || e.wants_training_frames();
    if (!training) config.report.training_frames = 0;
    if (training && config.report.training_frames == 0) config.report.training_frames = 1000000;
    if (!found.has_errors()) text = write_config(resolved_config(config));
  } catch (const Error& error) {
    found.error(error.code(), "", error.message(), error.remedy());
  }
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

// The dataset and its parameters: what a packed file depends on.
std::string scene_section(const std::string& config) {
  const ConfigNode root = parse_config_text(config, "cell");
  return write_config(root.find("scene")->without("labels").without("load"));
}

}  // namespace

std::string with_packed_scene(const std::string& config, const std::string& reader, const std::string& file) {
  const ConfigNode root = parse_config_text(config, "cell");
  ConfigNode scene = ConfigNode::make_map({}, {});
  scene = scene.with("type", ConfigNode::make_scalar(reader, false, {}));
  scene = scene.with("file", ConfigNode::make_scalar(file, true, {}));
  for (const char* key : {"labels", "load"}) {
    if (const ConfigNode* part = root.find("scene")->find(key)) scene = scene.with(key, *part);
  }
  return write_config(root.with("scene", scene));
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
            if (e.scenes[s].pack) cell.pack = hex64(fnv1a64(scene_section(cell.config)));
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
            cell.id = hex64(fnv1a64(identity_of(cell.config) + "\n" + cell.split + "\n" + cell.fuse.method + "\n" +
                                    cell.field_cell));
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

}  // namespace semfield
