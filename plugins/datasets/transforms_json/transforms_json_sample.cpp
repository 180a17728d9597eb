// A tiny scene with a transforms.json, whose cameras look along -z with y up.
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(transforms_json) {
  const SceneInfo scene = write_sample_images(folder, {"images/view_", "depth/view_", "labels/view_"});
  const Camera& camera = scene.frames[0].camera;
  nlohmann::json index{{"w", camera.width_px}, {"h", camera.height_px}, {"fl_x", camera.fx},
                       {"fl_y", camera.fy},    {"cx", camera.cx},       {"cy", camera.cy}};
  index["frames"] = nlohmann::json::array();
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const Pose& pose = scene.frames[i].world_from_camera;
    nlohmann::json matrix = nlohmann::json::array();
    for (std::size_t row = 0; row < 3; ++row)
      matrix.push_back({pose.r[row][0], -pose.r[row][1], -pose.r[row][2], pose.t[static_cast<int>(row)]});
    matrix.push_back({0.0, 0.0, 0.0, 1.0});
    const std::string file = "view_" + std::to_string(i) + ".png";
    index["frames"].push_back({{"file_path", "images/" + file},
                               {"depth_path", "depth/" + file},
                               {"label_path", "labels/" + file},
                               {"transform_matrix", matrix}});
  }
  write_file_atomic((fs::path(folder) / "transforms.json").string(), index.dump(1));
  return image_sample({{"root", "."}, {"test_every", "4"}});
}

}  // namespace semfield::testkit
