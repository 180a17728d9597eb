// The analytic room as image files, for samples of datasets made of images.
#pragma once

#include "formats/image_io.h"
#include "scene/dataset.h"
#include "tests/conformance/dataset_samples.h"

namespace semfield::testkit {

inline constexpr double kSampleHfovDeg =
    79.61114220853428;  ///< 2 atan(0.5 / 0.6): the analytic room's focal length is 0.6 widths

/// Prefixes of the images of a frame: "<prefix><name>.png"; folders are made.
struct SampleNames {
  std::string color, depth_mm, label;
};

/// Renders the analytic room into `folder`: 8-bit colour, 16-bit depth in millimetres, 8-bit class ids, and
/// classes.yaml. Frames are called as `name` says of their numbers. Returns its manifest.
SceneInfo write_sample_images(
    const std::string& folder, const SampleNames& names,
    const std::function<std::string(std::size_t)>& name = [](std::size_t i) { return std::to_string(i); });

/// What images of write_sample_images are read by and read as; absent in a build that reads no images.
DatasetSample image_sample(Settings settings, bool depth = true);

/// "r r r t" of each row of a pose, in all their digits, and "0 0 0 1"; `end` is behind each of the four.
std::string pose_rows(const Pose& pose, const char* end);

}  // namespace semfield::testkit
