// One frame kept as image files: checked by their headers, read into house units. Datasets made of image files share
// it.
#pragma once

#include <array>
#include <set>
#include <string>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "scene/scene.h"

namespace semfield {

/// Paths; "" where the frame has no such channel.
struct FrameFiles {
  std::string color, depth, label, instance;
};

/// What a label id outside the class table is; the parameter `unknown_labels` of datasets made of image files.
enum class UnknownLabels { error, as_void };
template <>
struct ChoiceNames<UnknownLabels> {
  static constexpr std::array<std::string_view, 2> names{"error", "void"};
};

struct FrameReadRules {
  double depth_unit_m = 0.001;       ///< metres of one step of an integer depth image; float images are in metres
  int alpha_background = -1;         ///< see read_rgb
  bool unknown_labels_void = false;  ///< false: an id outside the class table is an error
};

/// Headers only: every file there, every size equal to the camera's. Each problem goes into `diagnostics` under the
/// frame's place.
void check_frame_files(const FrameInfo& frame, const FrameFiles& files, Diagnostics& diagnostics);

/// Pixels. Depth 0, not finite, negative, or at the 16-bit ceiling 65535 reads as 0 (invalid). Throws Error naming
/// frame and file; a label outside `classes` with its x, y and value.
void read_frame_files(const FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                      const ClassTable& classes, FrameBuffer& out);

/// The class table nearest to a scene: classes.yaml, classes.yml, classes.csv, info_semantic.json in each folder in
/// turn; "" when none.
std::string find_class_file(const std::vector<std::string>& folders);

/// The class table `path`, or where that is empty the one that find_class_file finds. With labels but without a table,
/// and for a table that cannot be read, an error goes into `diagnostics` and the table is empty.
ClassTable load_class_file(const std::string& path, const std::vector<std::string>& folders, bool has_labels,
                           Diagnostics& diagnostics);

/// The stem of the image's path; where another frame took it, its folder is added, then a number.
std::string unique_frame_name(const std::string& image_path, std::set<std::string>& taken);

}  // namespace semfield
