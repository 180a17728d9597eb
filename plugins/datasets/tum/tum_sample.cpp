// A tiny recording in the layout of the TUM RGB-D benchmark.
#include <fmt/format.h>

#include "core/files.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(tum) {
  const fs::path root(folder);
  const SceneInfo scene = write_sample_images(folder, {"rgb/", "depth/", "labels/"});
  std::string images = "# color images\n# timestamp filename\n", depths = "# depth maps\n", poses = "# ground truth\n";
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const std::string name = std::to_string(i) + ".png";
    const std::string time = fmt::format("{:.4f}", 100 + 0.0333 * double(i));
    images += time + " rgb/" + name + "\n";
    depths += time + " depth/" + name + "\n";
    const Pose& pose = scene.frames[i].world_from_camera;
    const Quaternion q = quaternion_of(pose);
    poses += fmt::format("{} {:.12g} {:.12g} {:.12g} {:.12g} {:.12g} {:.12g} {:.12g}\n", time, pose.t.x, pose.t.y,
                         pose.t.z, q[1], q[2], q[3], q[0]);
  }
  write_file_atomic((root / "rgb.txt").string(), images);
  write_file_atomic((root / "depth.txt").string(), depths);
  write_file_atomic((root / "groundtruth.txt").string(), poses);
  const Camera& c = scene.frames.front().camera;
  const std::string lens = fmt::format("{:.12g},{:.12g},{:.12g},{:.12g}", c.fx, c.fy, c.cx - 0.5, c.cy - 0.5);
  return image_sample({{"root", "."}, {"label_dir", "labels"}, {"lens", lens}, {"depth_steps", "1000"}});
}

}  // namespace semfield::testkit
