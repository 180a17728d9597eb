// Poses that are not those given: of training frames, as a run has learned them; of others, fitted to a field that
// stays as it is. Where held-out cameras are given wrongly too, scores at their given poses say little of the field.
#pragma once

#include <vector>

#include "formats/safetensors.h"
#include "session/session.h"

namespace semfield {

/// Training frames of a session that was opened again get the poses that the checkpoint of its run has learned, with a
/// note of how far they lie from those given. Nothing happens where the run believed its poses.
void use_learned_poses(Session& session, const TensorFile& checkpoint, Diagnostics& diagnostics);

struct PoseRefinement {
  std::int64_t steps = 300;
  std::int64_t rays = 4096;     ///< of all frames together
  double learning_rate = 1e-3;  ///< radians and shares of the scene's half size; it falls to a tenth
};

/// Poses of `frames` under which the session's field shows their photographs best, by the colour loss alone; the same
/// for a seed. The session has tensors of a run, whose colours it knows. Throws Error.
std::vector<Pose> refine_poses(Session& session, Registry& registry, const std::vector<int>& frames,
                               const PoseRefinement& how = {});

}  // namespace semfield
