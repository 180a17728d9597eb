// One frame kept as image files: checked by their headers, read into house units. Datasets made of image files share
// it.
#pragma once

#include <string>

#include "scene/scene.h"

namespace semfield {

/// Paths; "" where the frame has no such channel.
struct FrameFiles {
  std::string color, depth, label, instance;
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

}  // namespace semfield
