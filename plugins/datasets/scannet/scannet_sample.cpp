// A tiny exported ScanNet scene: colour twice as large as depth and labels, raw ids in 16 bits.
#include <fmt/format.h>

#include "core/files.h"
#include "formats/image_io.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

namespace {

// Whole-number pixel centres, as ScanNet writes them.
std::string matrix_text(const Camera& camera) {
  return fmt::format("{:.17g} 0 {:.17g} 0\n0 {:.17g} {:.17g} 0\n0 0 1 0\n0 0 0 1\n", camera.fx, camera.cx - 0.5,
                     camera.fy, camera.cy - 0.5);
}

}  // namespace

SEMFIELD_DATASET_SAMPLE(scannet) {
  const fs::path root(folder);
  const SceneInfo scene = write_sample_images(folder, {"small/", "depth/", "ids/"});
  for (const char* name : {"color", "pose", "intrinsic", "label-filt"}) fs::create_directories(root / name);
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const std::string name = std::to_string(i) + ".png";
    const Image<std::uint8_t> small = read_rgb((root / "small" / name).string());
    std::vector<std::uint8_t> large;
    for (int y = 0; y < 2 * small.height_px; ++y) {
      for (int x = 0; x < 2 * small.width_px; ++x) {
        const auto* pixel = small.pixels.data() + 3 * ((y / 2) * small.width_px + x / 2);
        large.insert(large.end(), pixel, pixel + 3);
      }
    }
    write_png_rgb((root / "color" / name).string(), 2 * small.width_px, 2 * small.height_px, large);
    Image<std::uint16_t> ids = read_ids((root / "ids" / name).string());
    for (std::uint16_t& id : ids.pixels) id = static_cast<std::uint16_t>(id == 0 ? 0 : 1000 + id);
    write_png_gray16((root / "label-filt" / name).string(), ids.width_px, ids.height_px, ids.pixels);
    write_file_atomic((root / "pose" / (std::to_string(i) + ".txt")).string(),
                      pose_rows(scene.frames[i].world_from_camera, "\n"));
  }
  const Camera& depth = scene.frames.front().camera;
  write_file_atomic((root / "intrinsic/intrinsic_depth.txt").string(), matrix_text(depth));
  write_file_atomic((root / "intrinsic/intrinsic_color.txt").string(),
                    matrix_text(depth.resized(2 * depth.width_px, 2 * depth.height_px)));
  std::string table = "id\traw_category\tnyu40id\tnyu40class\n";
  for (const ClassEntry& entry : scene.classes.entries()) {
    if (entry.ignore) continue;
    table += std::to_string(1000 + entry.id) + "\tthe " + entry.name + "\t" + std::to_string(entry.id) + "\t" +
             entry.name + "\n";
  }
  write_file_atomic((root / "scannetv2-labels.combined.tsv").string(), table);
  fs::remove_all(root / "small");
  fs::remove_all(root / "ids");
  return image_sample({{"root", "."}});
}

}  // namespace semfield::testkit
