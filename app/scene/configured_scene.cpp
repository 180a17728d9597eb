#include "app/scene/configured_scene.h"

#include <utility>

#include "config/compose.h"

namespace semfield::app {

namespace {

OpenedDataset dataset_of(RunConfig config, AppContext& context) {
  OpenedDataset opened;
  opened.config = std::move(config);
  context.adopt(opened.config);
  DatasetBuild build;
  build.config_dir = opened.config.base_dir;
  opened.dataset = opened.config.dataset.entry->dataset(*opened.config.dataset.params, build);
  return opened;
}

}  // namespace

OpenedDataset dataset_of(const ConfigOptions& options, AppContext& context) {
  return dataset_of(load_run_config(options.config, options.set, context.registry), context);
}

OpenedDataset dataset_of(const ConfigNode& tree, const std::vector<std::string>& set, AppContext& context) {
  return dataset_of(run_config_of(compose_config_tree(tree, set), context.registry), context);
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
