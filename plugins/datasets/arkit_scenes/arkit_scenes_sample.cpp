// A tiny scene of ARKitScenes.
#include <fmt/format.h>

#include <cmath>

#include "core/files.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(arkit_scenes) {
  const fs::path root(folder);
  const auto time_of = [](std::size_t i) { return 6845.1 + 0.1 * static_cast<double>(i); };
  const auto stem_of = [&](std::size_t i) { return fmt::format("47333462_{:.3f}", time_of(i)); };
  const SceneInfo scene = write_sample_images(folder, {"lowres_wide/", "lowres_depth/", "labels/"}, stem_of);
  fs::create_directories(root / "lowres_wide_intrinsics");
  std::string trajectory;
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const Camera& c = scene.frames[i].camera;
    write_file_atomic(
        (root / "lowres_wide_intrinsics" / (stem_of(i) + ".pincam")).string(),
        fmt::format("{} {} {:.12g} {:.12g} {:.12g} {:.12g}\n", c.width_px, c.height_px, c.fx, c.fy, c.cx, c.cy));
    // Camera from world: the turn back, and the centre as the camera sees the world's origin.
    const Pose& pose = scene.frames[i].world_from_camera;
    Quaternion q = quaternion_of(pose);
    const double norm = std::hypot(q[1], q[2], q[3]);
    const double scale = norm > 0 ? -2 * std::atan2(norm, q[0]) / norm : 0;
    const Vec3d shift = pose.apply_inverse({0, 0, 0});
    trajectory += fmt::format("{:.6f} {:.12g} {:.12g} {:.12g} {:.12g} {:.12g} {:.12g}\n", time_of(i) + 0.0012,
                              scale * q[1], scale * q[2], scale * q[3], shift.x, shift.y, shift.z);
  }
  write_file_atomic((root / "lowres_wide.traj").string(), trajectory);
  return image_sample({{"root", "."}, {"label_dir", "labels"}});
}

}  // namespace semfield::testkit
