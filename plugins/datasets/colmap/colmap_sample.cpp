// A tiny scene with a COLMAP model in text, made of images twice as large as those on disk.
#include <sstream>

#include "core/files.h"
#include "scene/camera.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(colmap) {
  const SceneInfo scene = write_sample_images(folder, {"images/view_", "depth/view_", "labels/view_"});
  const Camera& small = scene.frames.front().camera;
  const Camera camera = small.resized(2 * small.width_px, 2 * small.height_px);
  std::ostringstream cameras, images;
  cameras.precision(17);
  images.precision(17);
  cameras << "# one camera\n1 PINHOLE " << camera.width_px << ' ' << camera.height_px << ' ' << camera.fx << ' '
          << camera.fy << ' ' << camera.cx << ' ' << camera.cy << '\n';
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const Pose& pose = scene.frames[i].world_from_camera;
    const Quaternion back = quaternion_of(pose);
    const double q[4] = {back[0], -back[1], -back[2], -back[3]};  // of camera from world
    const Vec3d t = pose.unrotate(pose.t) * -1.0;
    images << i + 1 << ' ' << q[0] << ' ' << q[1] << ' ' << q[2] << ' ' << q[3] << ' ' << t.x << ' ' << t.y << ' '
           << t.z << " 1 view_" << i << ".png\n\n";
  }
  const fs::path model = fs::path(folder) / "sparse/0";
  fs::create_directories(model);
  write_file_atomic((model / "cameras.txt").string(), cameras.str());
  write_file_atomic((model / "images.txt").string(), images.str());
  return image_sample({{"root", "."}, {"test_every", "4"}, {"label_dir", "labels"}}, false);
}

}  // namespace semfield::testkit
