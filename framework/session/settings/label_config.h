// `scene.labels.from` and `scene.labels.degrade`: steps chosen by type, read, written and documented.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "config/params_read.h"
#include "labels/training_labels.h"
#include "plugin/registry.h"

namespace semfield {

/// Reads both keys of the section `labels` (a map) into `config`. Paths of `from` start at the file that wrote them,
/// unless `paths_are_absolute`.
void read_label_steps(const ConfigNode& labels, bool paths_are_absolute, const Registry& registry, LabelConfig& config,
                      Diagnostics& diagnostics);

/// Makes the path of the key `clicks` absolute, as those of `from`. `of_a_run`: `labels` is that of a run.yaml, in
/// whose folder a relative path starts; an absolute one, which earlier versions wrote for the run's own file, gives way
/// to that file where it lies beside the run.yaml.
void anchor_click_file(const ConfigNode& labels, bool of_a_run, LabelConfig& config);

/// `labels` with the keys `from` and `degrade` of `config`; without steps the keys are absent.
ConfigNode with_label_steps(const ConfigNode& labels, const LabelConfig& config);

}  // namespace semfield
