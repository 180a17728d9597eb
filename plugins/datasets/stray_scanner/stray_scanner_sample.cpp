// A tiny recording of Stray Scanner whose video was taken apart.
#include <fmt/format.h>

#include "core/files.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(stray_scanner) {
  const fs::path root(folder);
  const SceneInfo scene =
      write_sample_images(folder, {"rgb/", "depth/", "labels/"}, [](std::size_t i) { return fmt::format("{:06}", i); });
  std::string rows = "timestamp, frame, x, y, z, qx, qy, qz, qw\n";
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const Pose& pose = scene.frames[i].world_from_camera;
    const Quaternion q = quaternion_of(pose);
    rows += fmt::format("{:.3f}, {:06}, {:.12g}, {:.12g}, {:.12g}, {:.12g}, {:.12g}, {:.12g}, {:.12g}\n",
                        100 + 0.0333 * double(i), i, pose.t.x, pose.t.y, pose.t.z, q[1], q[2], q[3], q[0]);
  }
  write_file_atomic((root / "odometry.csv").string(), rows);
  const Camera& c = scene.frames.front().camera;
  write_file_atomic(
      (root / "camera_matrix.csv").string(),
      fmt::format("{:.12g}, 0.0, {:.12g}\n0.0, {:.12g}, {:.12g}\n0.0, 0.0, 1.0\n", c.fx, c.cx, c.fy, c.cy));
  return image_sample({{"root", "."}, {"label_dir", "labels"}});
}

}  // namespace semfield::testkit
