// The views that `render` shows: of a split, of a trajectory file, or along a smooth path through the training cameras.
#pragma once

#include <string>
#include <vector>

#include "session/session.h"
#include "verbs.h"

namespace semfield::app {

struct NamedView {
  std::string name;  ///< of its files
  RayCamera camera;
};

/// Throws Error(usage) for an unknown split or a path without frames, Error(data) for a bad trajectory file and for
/// nothing to render.
std::vector<NamedView> render_views(const Session& session, const RenderOptions& options);

/// "test", "train", "smooth" or "trajectory": names the output.
std::string render_name(const RenderOptions& options);

}  // namespace semfield::app
