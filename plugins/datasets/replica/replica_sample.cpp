// A tiny scene in the layout of the pre-rendered Replica sequences.
#include <filesystem>
#include <sstream>

#include "formats/image_io.h"
#include "system/files.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

DatasetSample semfield_sample_replica(const std::string& folder);

DatasetSample semfield_sample_replica(const std::string& folder) {
  const SceneInfo scene = write_sample_images(folder, {"rgb/rgb_", "depth/depth_", "semantic_class/semantic_class_"});
  std::ostringstream poses;
  poses.precision(17);
  for (const FrameInfo& frame : scene.frames) {
    const Pose& pose = frame.world_from_camera;
    for (std::size_t row = 0; row < 3; ++row) {
      for (const double element : pose.r[row]) poses << element << ' ';
      poses << pose.t[static_cast<int>(row)] << ' ';
    }
    poses << "0 0 0 1\n";
  }
  write_file_atomic((std::filesystem::path(folder) / "traj_w_c.txt").string(), poses.str());
  DatasetSample sample;
  std::ostringstream hfov;
  hfov.precision(17);
  hfov << kSampleHfovDeg;
  sample.settings = {{"root", "."},         {"hfov_deg", hfov.str()}, {"train_step", "2"},
                     {"train_offset", "0"}, {"test_step", "2"},       {"test_offset", "1"}};
  sample.expected.frames = 12;
  sample.expected.depth = sample.expected.labels = true;
  if (!images_available()) sample.absent = "this build reads no images (SEMFIELD_WITH_IMAGES=OFF)";
  return sample;
}

}  // namespace semfield::testkit
