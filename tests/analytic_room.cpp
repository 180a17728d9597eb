// Packs the analytic room for tests in Python (program.py):
// analytic_room FILE [without_depth|without_labels|instances|FRAMES]. `instances`: its classes are objects too.
#include <cstdlib>
#include <string_view>

#include "scene/loading/packed_scene.h"
#include "tests/analytic_scene.h"

int main(int argc, char** argv) {
  using namespace semfield;
  if (argc < 2) return 2;
  const std::string_view word = argc > 2 ? argv[2] : "12";
  testkit::AnalyticSceneOptions options{.with_depth = word != "without_depth", .with_labels = word != "without_labels"};
  if (const int frames = std::atoi(word.data()); frames > 0) options.frames = frames;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
  Diagnostics diagnostics;
  SceneInfo info = scene->open(diagnostics);
  if (!options.with_labels) info.classes = {};
  for (FrameInfo& frame : info.frames) frame.has_instances = word == "instances";
  write_packed_scene(argv[1], info, [&](int frame, FrameBuffer& out) {
    scene->read(frame, out);
    if (word != "instances") return;
    for (const std::int16_t label : out.label) out.instance.push_back(static_cast<std::int32_t>(label + 1));
  });
}
