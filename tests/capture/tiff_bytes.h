// TIFF files by hand, with what a camera writes of itself.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace semfield::testing_room {

/// An uncompressed RGB picture of one grey, with the tags Make, Model and, in the EXIF directory, FocalLength in tenths
/// of a millimetre [TIFF 6.0, Exif 2.3].
inline std::string tiff_of(std::uint32_t width, std::uint32_t height, const std::string& make, const std::string& model,
                           std::uint32_t focal_tenths) {
  struct Tag {
    std::uint16_t id, type;
    std::uint32_t count, value;
  };
  constexpr std::uint16_t kShort = 3, kLong = 4, kText = 2, kRational = 5;
  std::string out = "II*";
  out.push_back('\0');
  const auto put = [&](auto value) { out.append(reinterpret_cast<const char*>(&value), sizeof value); };
  const std::uint32_t pixels = 3 * width * height;
  const std::uint32_t of_make = 8 + pixels, of_model = of_make + static_cast<std::uint32_t>(make.size()) + 1,
                      of_bits = of_model + static_cast<std::uint32_t>(model.size()) + 1, of_focal = of_bits + 6,
                      of_exif = of_focal + 8, directory = of_exif + 18;
  put(directory);
  out.append(pixels, '\x60');
  out.append(make.c_str(), make.size() + 1);
  out.append(model.c_str(), model.size() + 1);
  for (int i = 0; i < 3; ++i) put(std::uint16_t{8});
  put(focal_tenths);
  put(std::uint32_t{10});
  const auto put_tags = [&](const std::vector<Tag>& tags) {
    put(static_cast<std::uint16_t>(tags.size()));
    for (const Tag& tag : tags) {
      put(tag.id);
      put(tag.type);
      put(tag.count);
      put(tag.value);
    }
    put(std::uint32_t{0});
  };
  put_tags({{37386, kRational, 1, of_focal}});
  put_tags({{256, kLong, 1, width},
            {257, kLong, 1, height},
            {258, kShort, 3, of_bits},
            {259, kShort, 1, 1},
            {262, kShort, 1, 2},
            {271, kText, static_cast<std::uint32_t>(make.size()) + 1, of_make},
            {272, kText, static_cast<std::uint32_t>(model.size()) + 1, of_model},
            {273, kLong, 1, 8},
            {277, kShort, 1, 3},
            {278, kLong, 1, height},
            {279, kLong, 1, pixels},
            {34665, kLong, 1, of_exif}});
  return out;
}

}  // namespace semfield::testing_room
