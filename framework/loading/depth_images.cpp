#include "loading/depth_images.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <limits>

#include "core/error.h"
#include "formats/input_limits.h"
#include "formats/npz.h"

namespace semfield {

namespace {

std::string ending_of(const std::string& path) {
  std::string out = std::filesystem::path(path).extension().string();
  for (char& c : out) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return out;
}

// [height, width] of the array, whose other axes have one place.
std::vector<std::int64_t> plane_of(std::span<const std::int64_t> shape) {
  std::vector<std::int64_t> plane;
  for (const std::int64_t axis : shape)
    if (axis != 1 || shape.size() == 2) plane.push_back(axis);
  if (plane.size() != 2)
    throw Error(ErrorKind::data, "scene.depth.shape", "the shape is " + shape_text(shape),
                "save depth as an array [height, width]");
  check_image_limits(plane[1], plane[0], 1, sizeof(float));
  return plane;
}

Image<float> read_depth_array(const std::string& path, double unit_m) {
  const NumpyValues array = read_npy_values(path, [](std::span<const std::int64_t> shape) { (void)plane_of(shape); });
  const std::vector<std::int64_t> plane = plane_of(array.shape);
  Image<float> out{static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, {}};
  out.pixels.reserve(array.values.size());
  const double ceiling = array.is_whole && array.element_bytes == 2 ? 65535 : std::numeric_limits<float>::max();
  for (const double value : array.values)
    out.pixels.push_back(value > 0 && value < ceiling ? static_cast<float>(value * (array.is_whole ? unit_m : 1)) : 0);
  return out;
}

}  // namespace

// A TIFF holds integers or real numbers, which have 32 bits.
bool has_real_depth(const std::string& path) {
  const std::string ending = ending_of(path);
  if (ending == ".npy") return !npy_is_whole(path);
  if (ending == ".tif" || ending == ".tiff") return image_size(path).bits > 16;
  return ending == ".exr" || ending == ".pfm";
}

ImageSize depth_size(const std::string& path) {
  if (ending_of(path) != ".npy") return image_size(path);
  try {
    const std::vector<std::int64_t> plane = plane_of(npy_shape(path));
    return {static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, 32};
  } catch (const Error& e) {
    if (e.message().find(path) != std::string::npos) throw;
    throw Error(e.kind(), e.code(), "'" + path + "': " + e.message(), e.remedy());
  }
}

Image<float> read_depth(const std::string& path, double unit_m) {
  if (ending_of(path) == ".npy") return read_depth_array(path, unit_m);
  if (has_real_depth(path)) {
    Image<float> out = read_float(path);
    for (float& d : out.pixels)
      if (!std::isfinite(d) || d < 0) d = 0;
    return out;
  }
  const Image<std::uint16_t> image = read_ids(path);
  Image<float> out{image.width_px, image.height_px, 1, std::vector<float>(image.pixels.size())};
  for (std::size_t i = 0; i < out.pixels.size(); ++i)
    out.pixels[i] = image.pixels[i] == 65535 ? 0.0f : static_cast<float>(image.pixels[i] * unit_m);
  return out;
}

std::vector<float> at_nearest_pixels(const Image<float>& image, std::int32_t width, std::int32_t height) {
  const auto rows = nearest_pixels(image.height_px, height), cols = nearest_pixels(image.width_px, width);
  std::vector<float> out;
  out.reserve(rows.size() * cols.size());
  for (const std::int64_t row : rows) {
    const float* const line = image.pixels.data() + row * image.width_px;
    for (const std::int64_t col : cols) out.push_back(line[col]);
  }
  return out;
}

}  // namespace semfield
