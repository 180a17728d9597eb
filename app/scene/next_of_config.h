// What people do next with the configuration of a scene, and with a run.
#pragma once

#include <string>
#include <vector>

#include "app/next_steps.h"

namespace semfield::app {

struct KnownConfig {
  std::string file;  ///< or a shipped name
  std::string name;  ///< of its runs: runs/NAME
  bool labels = false;
  std::vector<std::string> set = {};  ///< what --set and its short forms gave
  std::vector<std::string> modules = {};
};

/// Training, and labelling in a run of its own, so that either works after the other. A run that is there already keeps
/// its folder.
std::vector<NextStep> next_of_config(const KnownConfig& config);

/// What fixes the cameras of a scene that do not fit its photographs; none where they do. `scene` is its folder, or a
/// configuration; `name` is what it is called.
std::vector<NextStep> next_of_cameras(bool off, const std::string& scene, const std::string& name);
/// The configuration of a scene's folder, which is written or is there already.
std::vector<NextStep> next_of_scene(const std::string& folder, const std::string& name);
/// What follows on a run that was trained: scores and pictures of its held-out frames, if it has any, and its surface.
std::vector<NextStep> next_of_run(const std::string& run, bool held_out);
/// The run in the browser, where the build has pages that are served.
std::vector<NextStep> next_of_look(const std::string& run);

}  // namespace semfield::app
