// The score of a mesh against a scene's depth images, for `mesh --score`.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "app/json_output.h"
#include "session/session.h"
#include "surface/mesh/score/mesh_score.h"

namespace semfield::app {

/// Depth images of a scene as views.
struct MeasuredDepth {
  std::vector<DepthView> training, held_out;
};
/// Of a session that keeps all depth. Throws Error(data) that names the run where no frame of the scene has a depth
/// image, or, with `training_needed`, no training frame.
MeasuredDepth measured_depth(const Session& session, const std::string& run, bool training_needed);

/// Scores of a run's mesh, and of what the same fusion makes of the depth images of its training frames.
struct MeshScores {
  double metre = 1;  ///< of distances, in units of the scene (usual_metre)
  std::size_t points = 0, held_out_points = 0;
  MeshScore mesh;
  std::optional<MeshScore> sensor;  ///< none without depth of training frames
};
Json scores_json(const MeshScores& scores);
/// A table with a line at each end. `metric`: the scene is in metres; distances are shown in centimetres, or else in
/// its own unit.
std::string scores_table(const MeshScores& scores, bool metric);

}  // namespace semfield::app
