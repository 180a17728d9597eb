// Writing the analytic room.
#include "tests/conformance/sample_files.h"

#include <sstream>

#include "core/files.h"
#include "tests/analytic_scene.h"

namespace semfield::testkit {

SceneInfo write_sample_images(const std::string& folder, const SampleNames& names,
                              const std::function<std::string(std::size_t)>& name) {
  const auto path_of = [&](const std::string& prefix, std::size_t i) {
    const fs::path path = fs::path(folder) / (prefix + name(i) + ".png");
    fs::create_directories(path.parent_path());
    return path.string();
  };
  const std::unique_ptr<Dataset> room = make_analytic_scene();
  Diagnostics diagnostics;
  SceneInfo scene = room->open(diagnostics);
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    FrameBuffer pixels;
    room->read(static_cast<int>(i), pixels);
    std::vector<std::uint16_t> depth_mm;
    std::vector<std::uint8_t> ids;
    for (const float depth : pixels.depth_m) depth_mm.push_back(static_cast<std::uint16_t>(std::lround(1000 * depth)));
    for (const std::int16_t label : pixels.label) ids.push_back(static_cast<std::uint8_t>(scene.classes.id_of(label)));
    write_png_rgb(path_of(names.color, i), pixels.width_px, pixels.height_px, pixels.rgb);
    write_png_gray16(path_of(names.depth_mm, i), pixels.width_px, pixels.height_px, depth_mm);
    write_png_gray8(path_of(names.label, i), pixels.width_px, pixels.height_px, ids);
  }
  write_file_atomic((fs::path(folder) / "classes.yaml").string(), scene.classes.to_yaml());
  return scene;
}

DatasetSample image_sample(Settings settings, bool depth) {
  DatasetSample sample{.settings = std::move(settings), .expected = {.frames = 12, .depth = depth, .labels = true}};
  if (!images_available()) sample.absent = "this build reads no images (SEMFIELD_WITH_IMAGES=OFF)";
  return sample;
}

std::string pose_rows(const Pose& pose, const char* end) {
  std::ostringstream out;
  out.precision(17);
  for (std::size_t row = 0; row < 3; ++row) {
    for (const double element : pose.r[row]) out << element << ' ';
    out << pose.t[static_cast<int>(row)] << end;
  }
  return out.str() + "0 0 0 1" + end;
}

}  // namespace semfield::testkit
