// The analytic room as image files, for samples of datasets made of images.
#pragma once

#include "plugin/dataset.h"

namespace semfield::testkit {

inline constexpr double kSampleHfovDeg =
    79.61114220853428;  ///< 2 atan(0.5 / 0.6): the analytic room's focal length is 0.6 widths

/// Prefixes of the four images of frame i: "<prefix><i>.png"; folders are made.
struct SampleNames {
  std::string color, depth_mm, label;
};

/// Renders the analytic room into `folder`: 8-bit colour, 16-bit depth in millimetres, 8-bit class ids, and
/// classes.yaml. Returns its manifest.
SceneInfo write_sample_images(const std::string& folder, const SampleNames& names);

}  // namespace semfield::testkit
