// A tiny recording of Stray Scanner whose video was taken apart.
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

DatasetSample semfield_sample_stray_scanner(const std::string& folder);

DatasetSample semfield_sample_stray_scanner(const std::string& folder) {
  const fs::path root(folder);
  const SceneInfo scene = write_sample_images(folder, {"color/", "mm/", "ids/"});
  for (const char* name : {"rgb", "depth", "labels"}) fs::create_directories(root / name);
  std::string rows = "timestamp, frame, x, y, z, qx, qy, qz, qw\n";
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const std::string from = std::to_string(i) + ".png", name = std::string(i < 10 ? "00000" : "0000") + from;
    fs::rename(root / "color" / from, root / "rgb" / name);
    fs::rename(root / "mm" / from, root / "depth" / name);
    fs::rename(root / "ids" / from, root / "labels" / name);
    const Pose& pose = scene.frames[i].world_from_camera;
    const Quaternion q = quaternion_of(pose);
    char row[256];
    std::snprintf(row, sizeof row, "%.3f, %06zu, %.12g, %.12g, %.12g, %.12g, %.12g, %.12g, %.12g\n",
                  100 + 0.0333 * double(i), i, pose.t.x, pose.t.y, pose.t.z, q[1], q[2], q[3], q[0]);
    rows += row;
  }
  write_file_atomic((root / "odometry.csv").string(), rows);
  const Camera& c = scene.frames.front().camera;
  char matrix[256];
  std::snprintf(matrix, sizeof matrix, "%.12g, 0.0, %.12g\n0.0, %.12g, %.12g\n0.0, 0.0, 1.0\n", c.fx, c.cx, c.fy, c.cy);
  write_file_atomic((root / "camera_matrix.csv").string(), std::string(matrix));
  for (const char* name : {"color", "mm", "ids"}) fs::remove_all(root / name);
  DatasetSample sample{.settings = {{"root", "."}, {"label_dir", "labels"}},
                       .expected = {.frames = 12, .depth = true, .labels = true}};
  if (!images_available()) sample.absent = "this build reads no images (SEMFIELD_WITH_IMAGES=OFF)";
  return sample;
}

}  // namespace semfield::testkit
