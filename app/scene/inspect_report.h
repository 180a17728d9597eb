// What a scene holds, as text and as JSON.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "scene/loading/frame_source.h"
#include "train/opened_run.h"

namespace semfield::app {

/// Frames, splits, sizes, extent, bounds, near and far, class table with pixel fractions of train and test and how many
/// labelled training frames see each class, then every problem with its remedy. `depth_use`: what training makes of
/// depth images (config/settings/run_config.h). Ends with a line feed.
std::string inspect_report(const LoadedScene& scene, const Diagnostics& diagnostics, const std::string& depth_use = "");
/// The same for programs.
Json inspect_json(const LoadedScene& scene, const Diagnostics& diagnostics, const std::string& depth_use = "");

// Which of the shipped presets suits a scene, from what was found in it.

struct PresetAdvice {
  std::string preset;  ///< as `include` takes it: "presets/room.yaml"
  std::string why;     ///< what was found, in one clause
  /// rendering.background, where the preset's own is another.
  std::optional<std::array<double, 3>> background;

  /// "presets/object.yaml with rendering.background: [0, 0.2, 1]: ..."
  std::string text() const;
};

/// Nothing of a scene that was not loaded. tests/datasets/datasets_test.cpp holds it against training.
std::optional<PresetAdvice> advised_preset(const LoadedScene& scene);

// What people do next with a scene, and with a run.

/// The configuration of a scene's folder, which is written or is there already.
std::vector<NextStep> next_of_scene(const std::string& folder, const std::string& name);
/// What follows on a run that was trained: scores and pictures of its held-out frames, if it has any, and its surface.
std::vector<NextStep> next_of_run(const std::string& run, bool held_out);
/// The run in the browser, where the build has pages that are served.
std::vector<NextStep> next_of_look(const std::string& run);

// A run opened for a verb: it works under its limits from here on.

/// What was found, as notes. With a configuration, as a shell reads it, a terminal gets only what is wrong, in a line
/// or two: `inspect` says the rest.
void print_findings(const AppContext& context, const Diagnostics& diagnostics, const std::string& config = {});

/// As open_run (train/opened_run.h), by all processes of the launcher; findings are printed.
OpenedRun run_of(const std::string& run, const std::vector<std::string>& set, OpenFor what, AppContext& context);

}  // namespace semfield::app
