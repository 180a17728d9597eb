#include "app/sweep/pack_cells.h"

#include <algorithm>
#include <filesystem>

#include "app/scene/folder_scene.h"
#include "app/sweep/cell_pool.h"
#include "core/workspace.h"
#include "loading/packed_scene.h"
#include "session/settings/run_config.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

// A packed copy whose header and list of frames are whole. Cells check what they read of it.
bool is_packed(const std::string& file, const SweepNote& note) {
  if (!fs::exists(file)) return false;
  try {
    const PackedScene scene(file);
    return true;
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::data) throw;
    note(error.message());
    return false;
  }
}

void pack_scene_of(const Cell& cell, const std::string& file, Registry& registry) {
  Diagnostics diagnostics;
  const RunConfig config = read_run_config(parse_config_text(cell.config, "cell"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  WorkSettings work = work_settings();
  work.limits = &config.limits;
  const WorkScope scope(work);
  const std::unique_ptr<Dataset> dataset = config.dataset.entry->dataset(*config.dataset.params, {config.base_dir});
  PackOptions whole;
  whole.depth_as_mm = false;  // the same bits as from the dataset
  pack_scene(*dataset, file, SceneLoadOptions{}, whole, diagnostics);
}

}  // namespace

void pack_scenes(const std::vector<Cell>& cells, const std::string& folder, Registry& registry, const SweepNote& note) {
  if (std::all_of(cells.begin(), cells.end(), [](const Cell& cell) { return cell.pack.empty(); })) return;
  const FolderLock alone = lock_when_free((fs::path(folder) / "scenes").string(), note);
  for (const Cell& cell : cells) {
    const std::string file = cell.pack.empty() ? "" : pack_file(folder, cell);
    if (file.empty() || is_packed(file, note)) continue;
    note("packing the scene '" + cell.scene + "'");
    pack_scene_of(cell, file, registry);
  }
}

}  // namespace semfield::app
