// A short training that looks where a scene is whose bounds only the cameras tell.
#pragma once

#include <optional>

#include "session/session.h"

namespace semfield {

/// The scene's extent is a guess, a probe is asked for and the run is at least four times as long.
bool probe_is_due(const Session& session);

/// Trains `session` for scene.load.probe_steps steps and surveys the depth that it then renders from the training
/// cameras; nothing where it shows no surface.
std::optional<SurveyedExtent> probe_extent(Session& session);

/// The extent of scene and configuration becomes what was seen, inside what was guessed; a note says so.
void use_probed_extent(const SurveyedExtent& seen, LoadedScene& scene, SceneLoadOptions& load,
                       Diagnostics& diagnostics);

}  // namespace semfield
