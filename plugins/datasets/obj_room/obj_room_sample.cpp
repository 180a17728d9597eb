// A tiny OBJ room: six inner faces and a crate, with cameras along a short slide.
#include "datasets/obj_room/obj_room.h"
#include "datasets/obj_room/tests/obj_testing.h"
#include "tests/conformance/dataset_samples.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(obj_room) {
  testing_obj::write_room(folder);
  DatasetSample sample{.settings = {{"root", "."},
                                    {"cameras", "cameras.txt"},
                                    {"width_px", "40"},
                                    {"height_px", "30"},
                                    {"frames", "4"},
                                    {"test_frames", "2"},
                                    {"supersample", "1"},
                                    {"occlusion_rays", "2"},
                                    {"shadow_rays", "1"}},
                       .expected = {.frames = 6, .depth = true, .labels = true}};
  if (!raycast_available()) sample.absent = "this build reads no meshes (SEMFIELD_WITH_RAYCAST=OFF)";
  return sample;
}

}  // namespace semfield::testkit
