// The surface of a run as `semfield mesh` is asked for it, with figures.
#pragma once

#include <optional>

#include "app/app_context.h"
#include "app/mesh/mesh_options.h"
#include "app/render/mesh_score_output.h"
#include "run/open_run.h"

namespace semfield::app {

struct FoundSurface : RunSurface {
  std::optional<MeshScores> scores;
};

inline constexpr long long kMeshResolution = 256;  ///< cells along the longest side, where none are asked for

/// What --voxel says, or the longest side over --resolution, or over `cells`.
double spacing_of(const MeshOptions& options, const Box& bounds, long long cells);

/// Throws Error(data) where there is no surface, or nothing of it is seen.
FoundSurface find_surface(const MeshOptions& options, OpenedRun& run, const AppContext& context);

}  // namespace semfield::app
