// Dataset: a scene's frames in house conventions, whatever the files look like.
#pragma once

#include <filesystem>
#include <string>

#include "scene/scene.h"

namespace semfield {

/// open() once, then read() from any thread.
class Dataset {
 public:
  virtual ~Dataset() = default;
  /// Reads everything but pixels. Every problem found goes into `diagnostics` (frame, file, cause, remedy); throws
  /// Error only when nothing can be listed (folder missing, unreadable index).
  virtual SceneInfo open(Diagnostics& diagnostics) = 0;
  /// Pixels of one frame, at the size that SceneInfo states. Thread-safe. Throws Error(data) naming the file.
  virtual void read(int frame, FrameBuffer& out) const = 0;
};

struct DatasetBuild {
  std::string config_dir;  ///< relative paths in parameters start here; "" = working directory
  /// A path of a parameter, from there; "" stays "", which means none.
  std::string path_of(const std::string& path) const {
    return path.empty() ? "" : (std::filesystem::path(config_dir) / path).string();
  }
};

}  // namespace semfield
