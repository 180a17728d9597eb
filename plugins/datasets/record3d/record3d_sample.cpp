// A tiny Record3D export: every third frame of a recording, colour twice as large as depth.
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "formats/image_io.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"
#include "tests/scene/image_bytes.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(record3d) {
  constexpr std::size_t kEvery = 3;
  const fs::path root(folder);
  const auto name_of = [](std::size_t i) { return std::to_string(kEvery * i); };
  const SceneInfo scene = write_sample_images(folder, {"rgb/", "mm/", "labels/"}, name_of);
  fs::create_directories(root / "depth");
  nlohmann::json poses = nlohmann::json::array();
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const Image<std::uint16_t> mm = read_ids((root / "mm" / (name_of(i) + ".png")).string());
    std::vector<float> half;
    for (std::int32_t y = 0; y < mm.height_px / 2; ++y) {
      for (std::int32_t x = 0; x < mm.width_px / 2; ++x)
        half.push_back(0.001f * mm.pixels[static_cast<std::size_t>((2 * y + 1) * mm.width_px + 2 * x + 1)]);
    }
    write_file_atomic((root / "depth" / (name_of(i) + ".exr")).string(),
                      testing_room::exr_of(mm.width_px / 2, mm.height_px / 2, half));
    const Pose pose = opencv_from_opengl(scene.frames[i].world_from_camera);
    const Quaternion q = quaternion_of(pose);
    const nlohmann::json row{q[1], q[2], q[3], q[0], pose.t.x, pose.t.y, pose.t.z};
    for (std::size_t k = 0; k < kEvery; ++k) poses.push_back(row);
  }
  const Camera& c = scene.frames.front().camera;
  const nlohmann::json meta{
      {"w", c.width_px}, {"h", c.height_px}, {"K", {c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1}}, {"poses", poses}};
  write_file_atomic((root / "metadata.json").string(), meta.dump());
  fs::remove_all(root / "mm");
  return image_sample({{"root", "."}, {"label_dir", "labels"}});
}

}  // namespace semfield::testkit
