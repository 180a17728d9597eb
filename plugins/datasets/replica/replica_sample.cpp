// A tiny scene in the layout of the pre-rendered Replica sequences.
#include <fmt/format.h>

#include "core/files.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(replica) {
  const SceneInfo scene = write_sample_images(folder, {"rgb/rgb_", "depth/depth_", "semantic_class/semantic_class_"});
  std::string poses;
  for (const FrameInfo& frame : scene.frames) poses += pose_rows(frame.world_from_camera, " ") + "\n";
  write_file_atomic((fs::path(folder) / "traj_w_c.txt").string(), poses);
  return image_sample({{"root", "."},
                       {"hfov_deg", fmt::format("{:.17g}", kSampleHfovDeg)},
                       {"train_step", "2"},
                       {"train_offset", "0"},
                       {"test_step", "2"},
                       {"test_offset", "1"}});
}

}  // namespace semfield::testkit
