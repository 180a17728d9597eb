// The dataset that a configuration names, opened without training.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "app/verb.h"
#include "loading/frame_source.h"

namespace semfield::app {

struct OpenedDataset {
  RunConfig config;
  std::unique_ptr<Dataset> dataset;
};

/// From here on the program works under the limits and with the threads of the configuration.
OpenedDataset dataset_of(const ConfigOptions& options, AppContext& context);
/// The same of a tree that no file holds.
OpenedDataset dataset_of(const ConfigNode& tree, const std::vector<std::string>& set, AppContext& context);

/// The scene with what its label steps require.
LoadedScene load_for_labels(OpenedDataset& opened, Diagnostics& diagnostics);

}  // namespace semfield::app
