// A tiny packed scene.
#include <filesystem>

#include "scene/loading/packed_scene.h"
#include "tests/analytic_scene.h"
#include "tests/conformance/dataset_samples.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(packed) {
  const std::unique_ptr<Dataset> room = make_analytic_scene();
  Diagnostics diagnostics;
  const SceneInfo scene = room->open(diagnostics);
  write_packed_scene((std::filesystem::path(folder) / "room.semfield").string(), scene,
                     [&](int frame, FrameBuffer& out) { room->read(frame, out); });
  return DatasetSample{.settings = {{"file", "room.semfield"}},
                       .expected = {.frames = 12, .depth = true, .labels = true}};
}

}  // namespace semfield::testkit
