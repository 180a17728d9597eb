// A tiny recording in the layout of the TUM RGB-D benchmark.
#include <cstdio>
#include <filesystem>

#include "formats/image_io.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "system/files.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

namespace fs = std::filesystem;

DatasetSample semfield_sample_tum(const std::string& folder);

DatasetSample semfield_sample_tum(const std::string& folder) {
  const fs::path root(folder);
  const SceneInfo scene = write_sample_images(folder, {"rgb/", "depth/", "labels/"});
  std::string images = "# color images\n# timestamp filename\n", depths = "# depth maps\n", poses = "# ground truth\n";
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const std::string name = std::to_string(i) + ".png";
    char time[32], row[256];
    std::snprintf(time, sizeof time, "%.4f", 100 + 0.0333 * double(i));
    images += std::string(time) + " rgb/" + name + "\n";
    depths += std::string(time) + " depth/" + name + "\n";
    const Pose& pose = scene.frames[i].world_from_camera;
    const Quaternion q = quaternion_of(pose);
    std::snprintf(row, sizeof row, " %.12g %.12g %.12g %.12g %.12g %.12g %.12g\n", pose.t.x, pose.t.y, pose.t.z, q[1],
                  q[2], q[3], q[0]);
    poses += time + std::string(row);
  }
  write_file_atomic((root / "rgb.txt").string(), images);
  write_file_atomic((root / "depth.txt").string(), depths);
  write_file_atomic((root / "groundtruth.txt").string(), poses);
  const Camera& c = scene.frames.front().camera;
  char lens[256];
  std::snprintf(lens, sizeof lens, "%.12g,%.12g,%.12g,%.12g", c.fx, c.fy, c.cx - 0.5, c.cy - 0.5);
  DatasetSample sample{.settings = {{"root", "."}, {"label_dir", "labels"}, {"lens", lens}, {"depth_steps", "1000"}},
                       .expected = {.frames = 12, .depth = true, .labels = true}};
  if (!images_available()) sample.absent = "this build reads no images (SEMFIELD_WITH_IMAGES=OFF)";
  return sample;
}

}  // namespace semfield::testkit
