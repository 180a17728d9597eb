// A tiny scene of ARKitScenes.
#include <cmath>
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

DatasetSample semfield_sample_arkit_scenes(const std::string& folder);

DatasetSample semfield_sample_arkit_scenes(const std::string& folder) {
  const fs::path root(folder);
  const SceneInfo scene = write_sample_images(folder, {"color/", "mm/", "ids/"});
  for (const char* name : {"lowres_wide", "lowres_wide_intrinsics", "lowres_depth", "labels"})
    fs::create_directories(root / name);
  std::string trajectory;
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const std::string from = std::to_string(i) + ".png";
    const double time = 6845.1 + 0.1 * static_cast<double>(i);
    char stem[64];
    std::snprintf(stem, sizeof stem, "47333462_%.3f", time);
    fs::rename(root / "color" / from, root / "lowres_wide" / (std::string(stem) + ".png"));
    fs::rename(root / "mm" / from, root / "lowres_depth" / (std::string(stem) + ".png"));
    fs::rename(root / "ids" / from, root / "labels" / (std::string(stem) + ".png"));
    const Camera& c = scene.frames[i].camera;
    char line[256];
    std::snprintf(line, sizeof line, "%d %d %.12g %.12g %.12g %.12g\n", c.width_px, c.height_px, c.fx, c.fy, c.cx,
                  c.cy);
    write_file_atomic((root / "lowres_wide_intrinsics" / (std::string(stem) + ".pincam")).string(), std::string(line));
    // Camera from world: the turn back, and the centre as the camera sees the world's origin.
    const Pose& pose = scene.frames[i].world_from_camera;
    Quaternion q = quaternion_of(pose);
    const double norm = std::hypot(q[1], q[2], q[3]);
    const double scale = norm > 0 ? -2 * std::atan2(norm, q[0]) / norm : 0;
    const Vec3d shift = pose.apply_inverse({0, 0, 0});
    std::snprintf(line, sizeof line, "%.6f %.12g %.12g %.12g %.12g %.12g %.12g\n", time + 0.0012, scale * q[1],
                  scale * q[2], scale * q[3], shift.x, shift.y, shift.z);
    trajectory += line;
  }
  write_file_atomic((root / "lowres_wide.traj").string(), trajectory);
  for (const char* name : {"color", "mm", "ids"}) fs::remove_all(root / name);
  DatasetSample sample{.settings = {{"root", "."}, {"label_dir", "labels"}},
                       .expected = {.frames = 12, .depth = true, .labels = true}};
  if (!images_available()) sample.absent = "this build reads no images (SEMFIELD_WITH_IMAGES=OFF)";
  return sample;
}

}  // namespace semfield::testkit
