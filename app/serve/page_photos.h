// Photographs of the views as their files have them: larger than those that train.
#pragma once

#include <memory>
#include <mutex>

#include "formats/image_io.h"
#include "plugin/dataset.h"
#include "session/session.h"

namespace semfield::app {

/// Reads a photograph when somebody looks at it closely; the last one is kept. From any thread, one at a time.
class PagePhotos {
 public:
  /// Borrows the session, of which only what never changes is read.
  explicit PagePhotos(const Session& session) : session_(session) {}

  /// The photograph of a frame, numbered as in the session's scene: the one that trains where that is at least
  /// `most_px` long (0: as long as there is), else the one of the dataset. Throws what the dataset throws, and
  /// Error(data) where the files are no longer those that were loaded.
  Image<std::uint8_t> read(int frame, std::int32_t most_px);

 private:
  void open();

  const Session& session_;
  std::mutex mutex_;
  std::unique_ptr<Dataset> dataset_;  // opened at the first photograph that is wanted larger
  SceneInfo info_;
  int kept_frame_ = -1;
  Image<std::uint8_t> kept_;
};

}  // namespace semfield::app
