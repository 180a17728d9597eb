// Images other than PNG, read by OpenImageIO in a library of its own that is loaded when the first such image is met:
// OpenImageIO brings some 250 libraries with it, which cost a quarter of a second and over 100 MB before anything runs.
#pragma once

#include <cstdint>
#include <string>

#include "formats/image_io.h"

namespace semfield {

/// What that library offers; every call throws Error(data) without the path for a file that cannot be read.
struct ImageFormats {
  ImageSize (*size)(const std::string& path);
  CameraTag (*camera)(const std::string& path);
  Image<std::uint8_t> (*read8)(const std::string& path);
  Image<std::uint16_t> (*read16)(const std::string& path);
  Image<float> (*read_float)(const std::string& path);
};

/// The table, loaded once. Throws Error(unavailable) in a build without OpenImageIO, and when the library is missing.
const ImageFormats& image_formats();

/// True once image_formats() has loaded the library.
bool image_formats_loaded();

/// The library's one exported symbol.
inline constexpr const char* kImageFormatsSymbol = "semfield_image_formats";

}  // namespace semfield
