// OpenEXR files by hand.
#pragma once

#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

namespace semfield::testing_room {

/// An uncompressed scan-line OpenEXR file with one float channel [OpenEXR file layout]. Its header states
/// `stated_width`, where that is above 0.
inline std::string exr_of(std::int32_t width, std::int32_t height, const std::vector<float>& values,
                          std::int32_t stated_width = 0) {
  std::string out;
  const auto put = [&](const auto& value) { out.append(reinterpret_cast<const char*>(&value), sizeof value); };
  const auto text = [&](const char* word) { out.append(word, std::strlen(word) + 1); };
  const auto attribute = [&](const char* name, const char* type, std::uint32_t size) {
    text(name);
    text(type);
    put(size);
  };
  const std::int32_t right = (stated_width > 0 ? stated_width : width) - 1;
  put(std::uint32_t{20000630});
  put(std::uint32_t{2});
  attribute("channels", "chlist", 19);
  text("Y");
  put(std::uint32_t{2});  // float
  put(std::uint32_t{0});
  put(std::uint32_t{1});
  put(std::uint32_t{1});
  out.push_back('\0');
  attribute("compression", "compression", 1);
  out.push_back('\0');
  for (const char* name : {"dataWindow", "displayWindow"}) {
    attribute(name, "box2i", 16);
    for (const std::int32_t edge : {0, 0, right, height - 1}) put(edge);
  }
  attribute("lineOrder", "lineOrder", 1);
  out.push_back('\0');
  attribute("pixelAspectRatio", "float", 4);
  put(1.0F);
  attribute("screenWindowCenter", "v2f", 8);
  put(0.0F);
  put(0.0F);
  attribute("screenWindowWidth", "float", 4);
  put(1.0F);
  out.push_back('\0');
  const std::size_t line = 8 + 4 * static_cast<std::size_t>(width),
                    first = out.size() + 8 * static_cast<std::size_t>(height);
  for (std::int32_t y = 0; y < height; ++y) put(static_cast<std::uint64_t>(first + static_cast<std::size_t>(y) * line));
  for (std::int32_t y = 0; y < height; ++y) {
    put(y);
    put(static_cast<std::uint32_t>(4 * width));
    for (std::int32_t x = 0; x < width; ++x) put(values[y * width + x]);
  }
  return out;
}

}  // namespace semfield::testing_room
