// A scene that no configuration names yet: what lies in a folder, which dataset reads it, and the configuration for it.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "config/config_tree.h"

namespace semfield::app {

/// Loads any scene, so that it can be looked at before one is advised.
inline constexpr const char* kUsualPreset = "presets/room.yaml";

struct FolderScene {
  std::string path;                 ///< as given
  std::string name;                 ///< of its folder: what the configuration and its runs are called
  std::string what;                 ///< in a few words: "a COLMAP model in sparse/0"
  std::string type;                 ///< name of the dataset that reads it
  std::vector<std::string> others;  ///< of those that could, too
  ConfigNode section;               ///< `scene` with absolute paths: the dataset, and what is not its default
  std::int32_t train_frames = 0, test_frames = 0;
  bool labels = false;                       ///< of any frame
  std::int32_t width_px = 0, height_px = 0;  ///< of its largest frame, as stored
};

/// Whether a word names a folder that is no run, or a file that a dataset knows, and no configuration.
bool names_a_scene(const std::string& word, const AppContext& context);

/// Asks every dataset for what it knows in `path`; of several, that takes the scene which brings most: labels, then
/// depth, then bounds. `type` names one that is to read it, "" = any. Throws Error(no_input) where none knows anything:
/// with what a dataset says of how it could be one.
FolderScene find_scene(const std::string& path, const std::string& type, AppContext& context);

/// The tree of a configuration: `preset` by include, the scene, and images of a size that trains well.
ConfigNode config_of(const FolderScene& scene, const std::string& preset);

/// What divides the sides of the scene's images in config_of.
int downscale_of(const FolderScene& scene);

}  // namespace semfield::app
