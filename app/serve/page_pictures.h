// Pictures of responses: JPEG, and PNG of labels with transparency.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "formats/image_io.h"
#include "labels/serve/label_state.h"
#include "labels/serve/view_pictures.h"

namespace semfield::app {

/// [[x, y], ...]
Json points_json(const std::vector<PixelPoint>& points);

inline constexpr int kMostPageClasses = 255;  ///< a palette has an entry for each and one for none

/// Class indices as a palette PNG: entry index + 1 has the class's colour, entry 0 is transparent and means none.
std::vector<std::uint8_t> label_png(std::int32_t width_px, std::int32_t height_px, std::span<const std::int16_t> label,
                                    const std::vector<ClassState>& classes);

/// The response to a request for a picture, as joined_parts: JSON of its facts, then JPEG, PNG of labels and PNG of
/// entropy, which are empty where there is none.
std::string picture_bytes(const Picture& picture, const std::vector<ClassState>& classes);

/// The response to a request for a thing, as joined_parts: JSON of its facts and outlines, and a PNG of its mask at the
/// size of `photo` (at most a few million pixels), 255 inside, along the photograph's edges. Outlines are in pixels of
/// the view, which is `view_px` wide. Of a picture that is stale the second part is empty.
std::string thing_bytes(const Picture& picture, const Image<std::uint8_t>& photo, std::int32_t view_px);

/// A photograph as JPEG, made smaller where its longest side is above `most_px`; 0: never.
std::vector<std::uint8_t> photo_jpeg(const Image<std::uint8_t>& photo, std::int32_t most_px);

/// JPEG by TurboJPEG. `rgb`: [height * width * 3]. Throws Error(internal) where TurboJPEG refuses.
std::vector<std::uint8_t> encode_jpeg(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> rgb,
                                      int quality = 85);

}  // namespace semfield::app
