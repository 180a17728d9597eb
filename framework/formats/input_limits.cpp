#include "formats/input_limits.h"

#include <algorithm>

#include "core/error.h"
#include "core/work_scope.h"
#include "system/files.h"

namespace semfield {

void describe(ParamVisitor& visit, InputLimits& p) {
  SEMFIELD_PARAM(visit, p, image_axis_px, "pixels along an axis of an image", {1, 1 << 20});
  SEMFIELD_PARAM(visit, p, image_pixels, "pixels of an image", {1, 1e12});
  SEMFIELD_PARAM(visit, p, image_channels, "channels of an image", {1, 1024});
  SEMFIELD_PARAM(visit, p, image_bytes, "bytes of an image once decoded", {1, 1e13});
  SEMFIELD_PARAM(visit, p, pose_file_bytes, "bytes of a file of poses, or of an index of frames", {1, 1e12});
  SEMFIELD_PARAM(visit, p, mesh_corners, "corners of all triangles of a mesh", {3, 2147483647});
  SEMFIELD_PARAM(visit, p, classes, "classes of a table, ignored ones not counted", {1, 32767});
  SEMFIELD_PARAM(visit, p, frames, "frames of a scene", {1, 1e8});
}

const InputLimits& input_limits() {
  static const InputLimits defaults;
  const InputLimits* own = work_settings().limits;
  return own != nullptr ? *own : defaults;
}

void check_input_limit(std::int64_t count, std::int64_t limit, const std::string& what, const std::string& noun,
                       const std::string& key) {
  if (count <= limit) return;
  throw Error(ErrorKind::data, "files.input.limit",
              what + std::to_string(count) + " " + noun + "; at most " + std::to_string(limit) + " are read",
              "check that it is the right file, or raise limits." + key + " in the configuration");
}

void check_image_limits(std::int64_t width, std::int64_t height, std::int64_t channels, std::int64_t bytes_a_value) {
  const std::string size = "image of " + std::to_string(width) + " x " + std::to_string(height) + " pixels: ";
  if (width < 1 || height < 1)
    throw Error(ErrorKind::data, "files.image.damaged",
                "image has no pixels (" + std::to_string(width) + " x " + std::to_string(height) + ")",
                "copy or export the file again");
  const InputLimits& most = input_limits();
  check_input_limit(std::max(width, height), most.image_axis_px, size, "pixels along an axis", "image_axis_px");
  check_input_limit(width * height, most.image_pixels, size, "pixels", "image_pixels");
  check_input_limit(channels, most.image_channels, size, "channels", "image_channels");
  check_input_limit(width * height * channels * bytes_a_value, most.image_bytes, size, "bytes once decoded",
                    "image_bytes");
}

std::string read_pose_file(const std::string& path) {
  const auto most = static_cast<std::size_t>(input_limits().pose_file_bytes);
  try {
    return read_text_file(path, most);
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::data) throw;
    throw Error(e.kind(), e.code(), e.message(), e.remedy() + ", or raise limits.pose_file_bytes in the configuration");
  }
}

}  // namespace semfield
