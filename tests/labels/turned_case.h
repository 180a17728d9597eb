// PNG files that viewers turn by an EXIF orientation.
#pragma once

#include "formats/image_io.h"
#include "system/files.h"
#include "tests/scene/png_bytes.h"

namespace semfield::testing_labels {

/// Adds the chunk eXIf to a PNG, before its last chunk.
inline void set_orientation(const std::string& path, int orientation) {
  const std::string file = read_text_file(path);
  std::vector<std::uint8_t> bytes(file.begin(), file.end() - 12);
  const auto value = static_cast<std::uint8_t>(orientation);
  testing_room::put_chunk(bytes, "eXIf", {'M', 'M', 0, 42, 0, 0, 0, 8, 0, 1, 1, 18, 0, 3, 0, 0, 0, 1, 0, value, 0, 0});
  testing_room::put_chunk(bytes, "IEND", {});
  write_file_atomic(path, std::string(bytes.begin(), bytes.end()));
}

/// As [Exif 2.3] has it, by hand: the stored pixel (x, y) that viewers show top left and top right, of a picture stored
/// as w x h pixels.
struct ShownCorners {
  int left_x, left_y, right_x, right_y;
};
inline ShownCorners shown_corners(int orientation, int w, int h) {
  const int r = w - 1, b = h - 1;
  const ShownCorners all[8] = {{0, 0, r, 0}, {r, 0, 0, 0}, {r, b, 0, b}, {0, b, r, b},
                               {0, 0, 0, b}, {0, b, 0, 0}, {r, b, r, 0}, {r, 0, r, b}};
  return all[orientation - 1];
}

}  // namespace semfield::testing_labels
