// How large inputs may be: what every reader asks before it takes memory on the word of a file.
#pragma once

#include <cstdint>
#include <string>

#include "config/params.h"

namespace semfield {

/// The section `limits` of a configuration.
struct InputLimits {
  std::int64_t image_axis_px = 16384;
  std::int64_t image_pixels = std::int64_t{1} << 28;
  std::int64_t image_channels = 16;
  std::int64_t image_bytes = std::int64_t{1} << 30;  ///< of one decoded image
  std::int64_t pose_file_bytes = std::int64_t{256} << 20;
  std::int64_t mesh_corners = (std::int64_t{1} << 31) - 1;
  std::int64_t classes = 1024;
  std::int64_t frames = std::int64_t{1} << 20;
};
void describe(ParamVisitor& visit, InputLimits& limits);

/// Those of this thread's work_settings(), or else the defaults.
const InputLimits& input_limits();

/// Throws Error(data) "WHAT: COUNT NOUN; at most LIMIT are read" whose remedy names `limits.KEY`, when count is above
/// limit.
void check_input_limit(std::int64_t count, std::int64_t limit, const std::string& what, const std::string& noun,
                       const std::string& key);

/// Refuses empty images and those over the limits of axis, pixels, channels and bytes once decoded.
void check_image_limits(std::int64_t width, std::int64_t height, std::int64_t channels = 1,
                        std::int64_t bytes_a_value = 1);

/// A file of poses or an index of frames as text; Error(data) above limits.pose_file_bytes, Error(no_input) as
/// read_text_file.
std::string read_pose_file(const std::string& path);

}  // namespace semfield
