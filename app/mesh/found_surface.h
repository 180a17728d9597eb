// The surface of a run as `semfield mesh` is asked for it, with colours, classes and figures.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "app/mesh/mesh_options.h"
#include "app/render/mesh_score_output.h"
#include "run/open_run.h"
#include "surface/mesh/surface.h"

namespace semfield::app {

struct FoundSurface {
  Surface surface;
  std::string source;     ///< depth, density or sensor
  std::string described;  ///< for notes and errors: "at a density of 8.7 / m", "in the depth of the training views"
  std::optional<double> level;
  double spacing = 0;      ///< of the grid, world units
  std::size_t unseen = 0;  ///< faces left out because no training camera saw them
  std::int64_t components = 0;
  std::size_t holes_closed = 0;
  std::optional<MeshScores> scores;
};

inline constexpr long long kMeshResolution = 256;  ///< cells along the longest side, where none are asked for

/// What --voxel says, or the longest side over --resolution, or over `cells`.
double spacing_of(const MeshOptions& options, const Box& bounds, long long cells);

std::vector<RayCamera> training_cameras(const Session& session);

/// Where the surface is taken from. Cameras that stand inside of what they see leave much of it unseen; what is alone
/// in empty space is seen from all around, and its density is the finer source. Throws Error(usage) for options that do
/// not go together.
std::string surface_source(const MeshOptions& options, const Session& session);

/// Throws Error(data) where there is no surface, or nothing of it is seen.
FoundSurface find_surface(const MeshOptions& options, OpenedRun& run, const AppContext& context);

}  // namespace semfield::app
