// Rendered maps and photographs as the page gets them.
#pragma once

#include <cstdint>
#include <memory>
#include <mutex>
#include <span>
#include <string>
#include <vector>

#include "formats/image_io.h"
#include "plugin/dataset.h"
#include "serve/label_loop.h"
#include "session/session.h"

namespace semfield::app {

inline constexpr int kMostPageClasses = 255;  ///< a palette has an entry for each and one for none

/// Class indices as a palette PNG: entry index + 1 has the class's colour, entry 0 is transparent and means none.
std::vector<std::uint8_t> label_png(std::int32_t width_px, std::int32_t height_px, std::span<const std::int16_t> label,
                                    const std::vector<ClassState>& classes);

/// The response to a request for a picture: JSON of its facts, then JPEG, PNG of labels and PNG of entropy, each behind
/// its length in four bytes, little-endian; 0 for one that there is not. `is_spot`: the request was about a point.
std::string picture_bytes(const Picture& picture, const std::vector<ClassState>& classes, bool is_spot);

/// A photograph as JPEG, made smaller where its longest side is above `most_px`; 0: never.
std::vector<std::uint8_t> photo_jpeg(const Image<std::uint8_t>& photo, std::int32_t most_px);

// Photographs of the views as their files have them: larger than those that train.

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

// JPEG pictures for the page, by TurboJPEG.

/// `rgb`: [height * width * 3]. Throws Error(internal) where TurboJPEG refuses.
std::vector<std::uint8_t> encode_jpeg(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> rgb,
                                      int quality = 85);

}  // namespace semfield::app
