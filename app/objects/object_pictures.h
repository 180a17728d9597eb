// Objects for the eye: a strip of panels for a view.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "objects/segments.h"

namespace semfield::app {

/// Writes a PNG of panels side by side: the photograph, the segments that were given (left out where `given` is empty),
/// the objects found and the true ones. A found object has the colour of the true one that it shares most pixels with;
/// what is no object is grey. `id` [H * W] objects found, 0: none; `stuff` [classes]. `frame` has labels and instances.
/// Throws as write_png_rgb.
void write_object_strip(const std::string& path, const StoredFrame& frame, const FrameSegments& given,
                        std::span<const std::int32_t> id, const std::vector<bool>& stuff);

}  // namespace semfield::app
