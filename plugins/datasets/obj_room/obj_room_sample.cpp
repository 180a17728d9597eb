// A tiny OBJ room: six inner faces and a crate, with cameras along a short slide.
#include <filesystem>
#include <sstream>

#include "datasets/obj_room/obj_room.h"
#include "system/files.h"
#include "tests/conformance/dataset_samples.h"

namespace semfield::testkit {

namespace {

// Four corners of each face of a box, x-, x+, y-, y+, z-, z+; corner bits choose lo or hi of x, y, z.
constexpr std::array<std::array<int, 4>, 6> kFaces{
    {{0, 2, 6, 4}, {1, 5, 7, 3}, {0, 4, 5, 1}, {2, 3, 7, 6}, {0, 1, 3, 2}, {4, 6, 7, 5}}};

void write_box(std::ostringstream& obj, const Box& box, const std::array<const char*, 6>& names, int& vertices) {
  for (int corner = 0; corner < 8; ++corner)
    obj << "v " << ((corner & 1) != 0 ? box.hi.x : box.lo.x) << ' ' << ((corner & 2) != 0 ? box.hi.y : box.lo.y) << ' '
        << ((corner & 4) != 0 ? box.hi.z : box.lo.z) << '\n';
  for (std::size_t face = 0; face < kFaces.size(); ++face) {
    obj << "o " << names[face] << "\nf";
    for (const int corner : kFaces[face]) obj << ' ' << vertices + corner + 1;
    obj << '\n';
  }
  vertices += 8;
}

}  // namespace

SEMFIELD_DATASET_SAMPLE(obj_room) {
  const std::filesystem::path root(folder);
  std::ostringstream obj;
  int vertices = 0;
  write_box(obj, {{-2, -1.5, 0}, {2, 1.5, 2.5}}, {"wall_1", "wall_2", "wall_3", "wall_4", "floor_1", "ceiling_1"},
            vertices);
  write_box(obj, {{-0.3, 0.6, 0}, {0.3, 1.1, 0.8}}, {"crate_1", "crate_2", "crate_3", "crate_4", "crate_5", "crate_6"},
            vertices);
  write_file_atomic((root / "room.obj").string(), obj.str());
  write_file_atomic(
      (root / "classes.yaml").string(),
      "- {id: 1, name: wall}\n- {id: 2, name: floor}\n- {id: 3, name: ceiling}\n- {id: 4, name: crate}\n");
  // Cameras at y = -1 look along +y: axes right +x, down -z, forward +y.
  std::ostringstream cameras;
  for (int i = 0; i < 6; ++i) cameras << "1 0 0 " << -0.5 + 0.2 * i << " 0 0 1 -1 0 -1 0 1.2\n";
  write_file_atomic((root / "cameras.txt").string(), cameras.str());
  DatasetSample sample{.settings = {{"root", "."},
                                    {"cameras", "cameras.txt"},
                                    {"width_px", "40"},
                                    {"height_px", "30"},
                                    {"frames", "4"},
                                    {"test_frames", "2"},
                                    {"supersample", "1"},
                                    {"occlusion_rays", "2"},
                                    {"shadow_rays", "1"}}};
  if (!raycast_available()) sample.absent = "this build reads no meshes (SEMFIELD_WITH_RAYCAST=OFF)";
  sample.expected.frames = 6;
  sample.expected.depth = sample.expected.labels = true;
  return sample;
}

}  // namespace semfield::testkit
