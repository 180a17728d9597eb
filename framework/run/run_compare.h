// Whether two runs are the same training: settings, scene and every bit of their newest checkpoints.
#pragma once

#include <cstdint>
#include <string>

#include "core/error.h"
#include "plugin/registry.h"

namespace semfield {

struct RunComparison {
  std::string difference;  ///< the first one in a sentence; "" = equal
  std::int64_t step = 0;   ///< of the first run's newest checkpoint
  std::size_t tensors = 0;
};

/// Compares, in this order: settings that are part of a run's identity, class tables, inputs, steps, tensors. Times,
/// threads, places of files and what reports show do not count. Settings are those of the checkpoints; a run.yaml that
/// says other ones is a warning. Throws Error(no_input) for a folder without a
/// checkpoint.
RunComparison compare_runs(const std::string& folder_a, const std::string& folder_b, Registry& registry,
                           Diagnostics& diagnostics);

}  // namespace semfield
