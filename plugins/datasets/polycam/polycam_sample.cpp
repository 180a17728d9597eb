// A tiny raw export of Polycam: names are times in microseconds, and every depth is of high confidence.
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "formats/image_io.h"
#include "scene/scene.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(polycam) {
  const fs::path root(folder);
  const auto name_of = [](std::size_t i) { return std::to_string(81'000'000 + 33'333 * i); };
  const SceneInfo scene = write_sample_images(folder, {"keyframes/images/", "keyframes/depth/", "labels/"}, name_of);
  const fs::path keyframes = root / "keyframes";
  for (const char* name : {"cameras", "confidence"}) fs::create_directories(keyframes / name);
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const std::string name = name_of(i);
    const Camera& c = scene.frames[i].camera;
    const std::vector<std::uint8_t> high(static_cast<std::size_t>(c.width_px * c.height_px), 255);
    write_png_gray8((keyframes / "confidence" / (name + ".png")).string(), c.width_px, c.height_px, high);
    const Pose pose = opencv_from_opengl(scene.frames[i].world_from_camera);
    nlohmann::json camera{{"fx", c.fx}, {"fy", c.fy},          {"cx", c.cx},
                          {"cy", c.cy}, {"width", c.width_px}, {"height", c.height_px}};
    for (std::size_t row = 0; row < 3; ++row) {
      const std::string key = "t_" + std::to_string(row);
      for (std::size_t column = 0; column < 3; ++column) camera[key + std::to_string(column)] = pose.r[row][column];
      camera[key + "3"] = pose.t[static_cast<int>(row)];
    }
    write_file_atomic((keyframes / "cameras" / (name + ".json")).string(), camera.dump());
  }
  return image_sample({{"root", "."}, {"label_dir", "labels"}});
}

}  // namespace semfield::testkit
