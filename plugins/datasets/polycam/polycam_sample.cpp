// A tiny raw export of Polycam: names are times in microseconds, and every depth is of high confidence.
#include <filesystem>
#include <nlohmann/json.hpp>

#include "formats/image_io.h"
#include "scene/scene.h"
#include "system/files.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

namespace fs = std::filesystem;

DatasetSample semfield_sample_polycam(const std::string& folder);

DatasetSample semfield_sample_polycam(const std::string& folder) {
  const fs::path root(folder);
  const SceneInfo scene = write_sample_images(folder, {"color/", "mm/", "ids/"});
  for (const char* name :
       {"keyframes/images", "keyframes/cameras", "keyframes/depth", "keyframes/confidence", "labels"})
    fs::create_directories(root / name);
  const fs::path keyframes = root / "keyframes";
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const std::string from = std::to_string(i) + ".png", name = std::to_string(81'000'000 + 33'333 * i);
    fs::rename(root / "color" / from, keyframes / "images" / (name + ".png"));
    fs::rename(root / "mm" / from, keyframes / "depth" / (name + ".png"));
    fs::rename(root / "ids" / from, root / "labels" / (name + ".png"));
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
  for (const char* name : {"color", "mm", "ids"}) fs::remove_all(root / name);
  DatasetSample sample{.settings = {{"root", "."}, {"label_dir", "labels"}},
                       .expected = {.frames = 12, .depth = true, .labels = true}};
  if (!images_available()) sample.absent = "this build reads no images (SEMFIELD_WITH_IMAGES=OFF)";
  return sample;
}

}  // namespace semfield::testkit
