#include "app/scene/configured_scene.h"

namespace semfield::app {

OpenedDataset dataset_of(const ConfigOptions& options, AppContext& context) {
  OpenedDataset opened;
  opened.config = load_run_config(options.config, options.set, context.registry);
  context.adopt(opened.config);
  DatasetBuild build;
  build.config_dir = opened.config.base_dir;
  opened.dataset = opened.config.dataset.entry->dataset(*opened.config.dataset.params, build);
  return opened;
}

LoadedScene load_for_labels(OpenedDataset& opened, Diagnostics& diagnostics) {
  SceneLoadOptions load = opened.config.load;
  load.depth = opened.config.labels.wants_depth() ? DepthKept::all : DepthKept::none;
  load.with_instances = opened.config.labels.needs_instances();
  LoadedScene scene = load_scene(*opened.dataset, load, diagnostics);
  open_label_files(scene, opened.config.labels, diagnostics);
  return scene;
}

}  // namespace semfield::app
